"""Access to the package for the golden tests: plain inputs, plain outputs.

The tests in `tests/golden` pin numbers and never change. This module follows the package when its code moves.
"""

import hashlib
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from nerfgrasp import GraspFinder
from nerfgrasp.evaluation.trials import Trials, observe, run_scene, scene_hash
from nerfgrasp.methods.loading import find_method, load_method, method_hash
from nerfgrasp.models import render_image
from nerfgrasp.models.folder import load_backbone, load_stored, weights_hash
from nerfgrasp.scenes.scene import Truth, Workspace
from nerfgrasp.search.strategies import find_strategy
from nerfgrasp.sim.attempt import demonstrate
from nerfgrasp.sim.physics import physics_hash
from nerfgrasp.sim.rendering import render_scene
from nerfgrasp.sim.tasks import find_task, scene_cameras

VIEWS = 3
_pybullet_objects = patch.dict(os.environ, {"NERFGRASP_OBJECTS": ""})
"""The novel task draws the objects that come with pybullet, whatever folder the environment names."""


@_pybullet_objects
def draw(task: str, seed: int, index: int) -> Truth:
    """Returns one scene of a task."""
    return find_task(task).draw(seed, index)


def scene_sha256(task: str, seed: int, index: int) -> str:
    """Returns the hash of a scene and its cameras, as results name it."""
    return scene_hash(draw(task, seed, index), scene_cameras(seed, index, VIEWS))


def default_physics_hash() -> str:
    """Returns the hash of the physics with the default gripper."""
    return physics_hash()


def model_sha256(name: str) -> str:
    """Returns the hash of a shipped model's weights."""
    if name.startswith("tn"):
        from nerfgrasp_baselines.transporter.network import Attention

        return weights_hash(load_stored(name, Attention))
    from nerfgrasp.models.folder import load_model

    return weights_hash(load_model(name))


def demonstration(task: str, seed: int, index: int) -> list[list[float]] | None:
    """Returns the demonstrated grasp `[4][4]` of a scene."""
    grasp = demonstrate(draw(task, seed, index))
    return None if grasp is None else grasp.tolist()


def picture_sha256(task: str, seed: int, index: int, size: int) -> dict[str, str]:
    """Returns hashes of a scene's pictures by the default renderer: pixels, masks and depth."""
    parts = render_scene(draw(task, seed, index), scene_cameras(seed, index, VIEWS, size), depth=True)
    return {name: _sha256(part) for name, part in zip(("images", "masks", "depth"), parts, strict=True)}


def rendered_colours(model: str, seed: int, index: int, size: int) -> list[float]:
    """Returns a model's small rendering `[size · size · 3]` of a simple scene's first view."""
    network = load_backbone(model)
    seen = observe(draw("simple", seed, index), scene_cameras(seed, index, VIEWS))
    features = network.observe(seen.images[None], _batch(seen.camera), Workspace())
    target = scene_cameras(seed, index, VIEWS + 1, size)[VIEWS]
    colours, _, _ = render_image(network, features, target, Workspace())
    return colours.flatten().tolist()


def grasps(model: str, strategy: str, seed: int, index: int, candidates: int) -> dict[str, Any]:
    """Returns the three best grasps of a strategy in a simple scene, and their values."""
    seen = observe(draw("simple", seed, index), scene_cameras(seed, index, VIEWS))
    finder = GraspFinder.from_pretrained(model)
    scene = finder.observe_scene(seen, Workspace())
    found = finder.grasps(scene, 3, strategy=find_strategy(strategy, candidates=candidates), seed=seed)
    return {"T_world_grasp": found.T_world_grasp.tolist(), "value": found.value.tolist()}


@_pybullet_objects
def rows(task: str, method: str, seed: int, scenes: int) -> list[dict[str, Any]]:
    """Returns the results of every attempt in the first scenes of a set, one flat dictionary an attempt."""
    spec = find_method(method)
    trials = Trials(find_task(task), seed, spec, method_hash(load_method(spec)))
    return [asdict(row) for scene in range(scenes) for row, _ in run_scene(trials, scene)]


def training_losses(kind: str, make_set: Callable[..., Path], network: Any, folder: Path) -> list[float]:
    """Returns the losses of the first two steps of a tiny training: `mvnerf`, `softmax`, `binary` or `transporter`."""
    from nerfgrasp.data.streams import SceneSet

    kept = {"demonstrations": True, "depth": kind == "transporter"}
    path = make_set(folder / f"set-{kind}", scenes=4, views=6, size=48, physics=physics_hash(), **kept)
    scenes = SceneSet(path, 4, 6, 5, size=48, **kept)
    module, data = _training(kind, scenes, network, folder)
    data.setup("fit")
    optimizer = torch.optim.Adam([p for p in module.parameters() if p.requires_grad], lr=3e-3)
    generator = np.random.default_rng(3)
    losses = []
    module.log = lambda *args, **kwargs: None
    for step in range(2):
        loss = module.training_step(data.draw(generator), step)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    return losses


def _training(kind: str, scenes: Any, network: Any, folder: Path) -> tuple[Any, Any]:
    from nerfgrasp.data.grasps import GraspData, Negatives
    from nerfgrasp.data.rays import RayData
    from nerfgrasp.models import MVNeRF
    from nerfgrasp.models.folder import save_model
    from nerfgrasp.training import GraspValueTraining, MVNeRFTraining

    if kind == "mvnerf":
        return MVNeRFTraining(network), RayData(scenes, scenes, scenes_per_step=2, rays_per_scene=32)
    if kind == "transporter":
        from nerfgrasp_baselines.transporter.data import HeightMapData
        from nerfgrasp_baselines.transporter.network import TransporterConfig
        from nerfgrasp_baselines.transporter.training import TransporterTraining

        shape = TransporterConfig(widths=(8, 16), blocks=1, fold=2, skips=True, rotations=6, pixel=0.0125)
        return TransporterTraining(shape), HeightMapData(scenes, scenes, pixel=0.0125)
    torch.manual_seed(0)
    save_model(folder / "backbone", MVNeRF(network))
    data = GraspData(scenes, scenes, scenes_per_step=2, negatives=Negatives(uniform=12, near=3), random_views=False)
    return GraspValueTraining(str(folder / "backbone"), loss=kind), data


def _batch(camera: Any) -> Any:
    return type(camera)(camera.intrinsics[None], camera.T_world_camera[None], camera.width, camera.height)


def _sha256(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
