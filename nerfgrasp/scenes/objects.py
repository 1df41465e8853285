"""An object of a scene: a prism, which is all there in the scene, or a mesh, which a catalogue holds."""

from typing import Any

from nerfgrasp.scenes.meshes import MeshObject
from nerfgrasp.scenes.prisms import Prism

SceneObject = Prism | MeshObject
"""Either has `T_world_object` and `to_json`; `dataclasses.replace` moves it."""


def object_from_json(data: dict[str, Any]) -> SceneObject:
    """Reads what an object's `to_json` wrote; a missing key is a KeyError."""
    return MeshObject.from_json(data) if data["kind"] == MeshObject.kind else Prism.from_json(data)


def object_name(thing: SceneObject) -> str:
    """Returns what a person calls it: a mesh's name, a prism's kind."""
    return thing.name if isinstance(thing, MeshObject) else thing.kind
