"""Pictures of simulated scenes by PyBullet's TinyRenderer, which needs no GPU and no display."""

from dataclasses import dataclass
from typing import Literal, overload

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from nerfgrasp.geometry import Camera, pixel_centres, pixel_rays
from nerfgrasp.scenes.meshes import MeshObject
from nerfgrasp.scenes.objects import SceneObject
from nerfgrasp.scenes.prisms import Polygon, Prism
from nerfgrasp.scenes.scene import Truth
from nerfgrasp.sim.bullet import p, quaternion
from nerfgrasp.sim.tasks import scene_generator

NEAR, FAR = 0.05, 4.0
TINY_SHIFT = (-0.5, 0.5)
"""Pixels. TinyRenderer samples a pixel at its lower left corner; shifting the principal point by this puts the
sample at the pixel's centre, where ours is."""
_LIGHT_STREAM = 10


@dataclass(frozen=True)
class Lighting:
    """What varies in a picture beside the objects."""

    direction: tuple[float, float, float]
    """Towards the light, in the world."""
    ambient: float
    """Light without direction, 0 to 1."""
    table: tuple[float, float, float]
    """The table's RGB colour in [0, 1]."""

    def table_in_pictures(self) -> NDArray[np.uint8]:
        """Returns the one RGB colour `[3]` that a large matt table has under a directional light from above.

        Painting it behind the objects equals rendering the table, in a fifth of the time.
        """
        brightness = self.ambient + (1.0 - self.ambient) * self.direction[2]
        return (255 * brightness * np.asarray(self.table)).astype(np.uint8)


def scene_lighting(seed: int, index: int) -> Lighting:
    """Returns the light and the table's colour of one scene, a function of (seed, index) alone."""
    rng = scene_generator(seed, index, _LIGHT_STREAM)
    polar, azimuth = rng.uniform(0.2, 0.9), rng.uniform(-np.pi, np.pi)
    direction = (np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar))
    grey, warmth = rng.uniform(0.62, 0.82), rng.uniform(0.0, 0.12)
    table = (float(grey), float(grey - warmth / 3), float(grey - warmth))
    return Lighting(
        (float(direction[0]), float(direction[1]), float(direction[2])), float(rng.uniform(0.5, 0.7)), table
    )


Picture = NDArray[np.uint8]


@overload
def render_scene(truth: Truth, camera: Camera, *, depth: Literal[False] = False) -> tuple[Picture, Picture]: ...


@overload
def render_scene(
    truth: Truth, camera: Camera, *, depth: Literal[True]
) -> tuple[Picture, Picture, NDArray[np.float32]]: ...


def render_scene(
    truth: Truth, camera: Camera, *, depth: bool = False
) -> tuple[Picture, Picture] | tuple[Picture, Picture, NDArray[np.float32]]:
    """Renders a scene from every camera.

    Args:
        truth: the scene.
        camera: batch shape `[V]`.
        depth: whether to return depth as well.

    Returns:
        RGB `[V, H, W, 3]`, the objects' mask `[V, H, W]`: 0 where there is none, else i + 1 for
        `truth.objects[i]`; and, if asked for, depth `[V, H, W]`: metres along the optical axis to the object or
        the table, infinite where a ray meets neither.

    Raises:
        UserError: the files of a mesh object are not here.
    """
    client = p.connect(p.DIRECT)
    try:
        lighting = scene_lighting(truth.seed, truth.index)
        for thing in truth.objects:
            _add_object(client, thing)
        views = [_render_view(client, lighting, camera[view]) for view in range(len(camera))]
    finally:
        p.disconnect(client)
    images, masks = np.stack([rgb for rgb, _, _ in views]), np.stack([mask for _, mask, _ in views])
    if not depth:
        return images, masks
    behind = np.stack([table_depth(camera[view]) for view in range(len(camera))])
    return images, masks, np.where(masks > 0, np.stack([metres for _, _, metres in views]), behind)


def table_depth(camera: Camera) -> NDArray[np.float32]:
    """Returns metres `[H, W]` along the optical axis to the plane z = 0; infinite for rays that miss it."""
    _, directions = pixel_rays(camera, pixel_centres(camera.width, camera.height).reshape(-1, 2))
    T_world_camera = camera.T_world_camera.double().numpy()
    rays = directions.double().numpy()
    along, down = rays @ T_world_camera[:3, 2], -rays[:, 2]
    height = T_world_camera[2, 3]
    metres = np.where(down > 0, height * along / np.maximum(down, 1e-12), np.inf)
    return metres.reshape(camera.height, camera.width).astype(np.float32)


def projection_matrix(intrinsics: Tensor, width: int, height: int) -> list[float]:
    """Returns the projection matrix for TinyRenderer, column by column, of `intrinsics` `[3, 3]` in pixels."""
    (fx, _, cx), (_, fy, cy), _ = intrinsics.tolist()
    cx, cy = cx + TINY_SHIFT[0], cy + TINY_SHIFT[1]
    depth, shift = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    columns = [[2 * fx / width, 0, 0, 0], [0, 2 * fy / height, 0, 0]]
    columns += [[1 - 2 * cx / width, 2 * cy / height - 1, depth, -1], [0, 0, shift, 0]]
    return [value for column in columns for value in column]


def view_matrix(T_world_camera: Tensor) -> list[float]:
    """Returns OpenGL's view matrix, column by column, of an OpenCV camera pose `[4, 4]`."""
    T_camera_world = np.linalg.inv(T_world_camera.double().numpy())
    return (np.diag([1.0, -1.0, -1.0, 1.0]) @ T_camera_world).T.reshape(-1).tolist()


def prism_mesh(prism: Prism) -> tuple[NDArray[np.float64], NDArray[np.float64], list[int]]:
    """Returns the triangles of all parts: vertices `[N, 3]`, their normals `[N, 3]` and indices; flat faces."""
    meshes = [_part_mesh(part, prism.height) for part in prism.parts]
    starts = np.cumsum([0] + [len(vertices) for vertices, _, _ in meshes])
    indices = [int(i + start) for (_, _, part), start in zip(meshes, starts, strict=False) for i in part]
    return np.concatenate([m[0] for m in meshes]), np.concatenate([m[1] for m in meshes]), indices


def _part_mesh(part: Polygon, height: float) -> tuple[NDArray[np.float64], NDArray[np.float64], list[int]]:
    corners = np.asarray(part)
    count = len(corners)
    vertices = [np.column_stack([corners, np.full(count, z)]) for z in (height, 0.0)]
    normals = [np.tile([0.0, 0.0, up], (count, 1)) for up in (1.0, -1.0)]
    fan = [(0, k, k + 1) for k in range(1, count - 1)]
    indices = [i for a, b, c in fan for i in (a, b, c)] + [count + i for a, b, c in fan for i in (a, c, b)]
    for k in range(count):
        a, b = corners[k], corners[(k + 1) % count]
        vertices.append(np.array([[*a, 0.0], [*b, 0.0], [*b, height], [*a, height]]))
        outward = np.array([b[1] - a[1], a[0] - b[0], 0.0])
        normals.append(np.tile(outward / np.linalg.norm(outward), (4, 1)))
        first = 2 * count + 4 * k
        indices += [first, first + 1, first + 2, first, first + 2, first + 3]
    return np.concatenate(vertices), np.concatenate(normals), indices


def _add_object(client: int, thing: SceneObject) -> None:
    """Adds an object; bodies are numbered from 0 in the order in which they are added."""
    if isinstance(thing, MeshObject):
        _add_mesh(client, thing)
    else:
        _add_prism(client, thing)


def _add_mesh(client: int, thing: MeshObject) -> None:
    from nerfgrasp.sim.catalogue import model_of  # reads meshes: only where there are any

    shape = p.createVisualShape(
        p.GEOM_MESH,
        fileName=str(model_of(thing).visual),
        rgbaColor=[1.0, 1.0, 1.0, 1.0],
        specularColor=[0.0, 0.0, 0.0],
        physicsClientId=client,
    )
    p.createMultiBody(
        baseVisualShapeIndex=shape,
        basePosition=thing.T_world_object[:3, 3].tolist(),
        baseOrientation=quaternion(thing.T_world_object[:3, :3].double().numpy()),
        physicsClientId=client,
    )


def _add_prism(client: int, prism: Prism) -> None:
    """Adds the mesh already moved to the world."""
    vertices, normals, indices = prism_mesh(prism)
    T = prism.T_world_object.double().numpy()
    shape = p.createVisualShape(
        p.GEOM_MESH,
        vertices=(vertices @ T[:3, :3].T + T[:3, 3]).tolist(),
        normals=(normals @ T[:3, :3].T).tolist(),
        indices=indices,
        rgbaColor=[*prism.colour, 1.0],
        specularColor=[0.0, 0.0, 0.0],
        physicsClientId=client,
    )
    p.createMultiBody(baseVisualShapeIndex=shape, physicsClientId=client)


def _render_view(client: int, lighting: Lighting, camera: Camera) -> tuple[Picture, Picture, NDArray[np.float32]]:
    """Returns RGB, mask and depth, the last of which holds for objects alone."""
    _, _, rgba, buffer, segmentation = p.getCameraImage(
        camera.width,
        camera.height,
        viewMatrix=view_matrix(camera.T_world_camera),
        projectionMatrix=projection_matrix(camera.intrinsics, camera.width, camera.height),
        lightDirection=lighting.direction,
        lightColor=[1.0, 1.0, 1.0],
        lightAmbientCoeff=lighting.ambient,
        lightDiffuseCoeff=1.0 - lighting.ambient,
        lightSpecularCoeff=0.0,
        shadow=0,
        renderer=p.ER_TINY_RENDERER,
        physicsClientId=client,
    )
    shape = (camera.height, camera.width)
    rgb = np.asarray(rgba, dtype=np.uint8).reshape(*shape, 4)[..., :3]
    mask = (np.asarray(segmentation, dtype=np.int64).reshape(shape) + 1).clip(min=0).astype(np.uint8)
    closeness = np.asarray(buffer, dtype=np.float64).reshape(shape)
    metres = FAR * NEAR / (FAR - (FAR - NEAR) * closeness)
    return np.where(mask[..., None] == 0, lighting.table_in_pictures(), rgb), mask, metres.astype(np.float32)
