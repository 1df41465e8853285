"""The check of pose parameterizations."""

import math
from collections.abc import Callable
from typing import Any

import roma
import torch
from torch import Tensor

from nerfgrasp.geometry import is_rigid, make_pose
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.schedule import GROUPS
from nerfgrasp.testing.conformance import ConformanceError, require

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-9}
"""Maximum error of a round trip in any entry of a transform (metres for positions)."""


def check_pose(pose_class: Callable[[], Any]) -> None:
    """Checks a pose parameterization: a class whose constructor needs no arguments.

    In both precisions: `decode(encode(T)) == T`, also for the identity and half-turns; every batch shape; `decode`
    gives a rigid transform for any parameters that gradient ascent may reach, and its gradients agree with finite
    differences; `project` ends in the workspace, is idempotent, and leaves valid poses alone.

    Raises:
        ConformanceError: a requirement is not met.
    """
    pose = pose_class()
    for dtype in (torch.float32, torch.float64):
        poses = sample_poses(dtype)
        _check_round_trip(pose, poses)
        _check_batch_shapes(pose, poses)
        _check_decode_off_manifold(pose, poses)
        _check_project(pose, poses)
    _check_gradients(pose, sample_poses(torch.float64))


def sample_poses(dtype: torch.dtype = torch.float32) -> Tensor:
    """Returns poses `[P, 4, 4]` in the default workspace, with rotations that are hard for parameterizations.

    They are the identity, tiny rotations, half-turns (every top-down grasp is one), almost half-turns and random
    rotations, the same in every call.
    """
    generator = torch.Generator().manual_seed(0)
    axes = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [-1, 2, 3]], dtype=torch.float64)
    axes = axes / axes.norm(dim=-1, keepdim=True)
    angles = torch.tensor([1e-7, math.pi / 2, math.pi - 1e-6, math.pi], dtype=torch.float64)
    special = roma.rotvec_to_rotmat((angles[:, None, None] * axes).reshape(-1, 3))
    random = roma.random_rotmat(16, dtype=torch.float64, generator=generator)
    rotations = torch.cat([torch.eye(3, dtype=torch.float64)[None], special, random])
    workspace = Workspace()
    unit = torch.rand(len(rotations), 3, generator=generator)
    positions = workspace.minimum + unit * (workspace.maximum - workspace.minimum)
    return make_pose(rotations, positions.double()).to(dtype)


def _check_round_trip(pose: Any, poses: Tensor) -> None:
    params = pose.encode(poses)
    require(set(params) in GROUPS, f"groups are position and orientation, or pose, not {sorted(params)}")
    for group, param in params.items():
        require(param.dtype == poses.dtype, f"encode turns {poses.dtype} into {param.dtype} in {group!r}")
    _require_close(pose.decode(params), poses, "decode(encode(T)) is T")


def _check_batch_shapes(pose: Any, poses: Tensor) -> None:
    for shape in ((), (0,), (1,), (2, 3)):
        batch = poses[: math.prod(shape)].reshape(*shape, 4, 4)
        try:
            params = pose.encode(batch)
            decoded = pose.decode(params)
            projected = pose.project(params, Workspace())
        except Exception as error:
            raise ConformanceError(f"batch shape {shape} fails: {type(error).__name__}: {error}") from error
        _require_close(decoded, batch, f"decode(encode(T)) is T in batch shape {shape}")
        for group, param in params.items():
            require(param.shape[:-1] == shape, f"encode gives {group!r} {tuple(param.shape)} for batch shape {shape}")
            require(projected[group].shape == param.shape, f"project keeps the shape of {group!r}")


def _check_decode_off_manifold(pose: Any, poses: Tensor) -> None:
    T = pose.decode(_astray(pose, poses))
    require(bool(is_rigid(T).all()), "decode gives rigid transforms wherever ascent may carry the parameters")


def _check_project(pose: Any, poses: Tensor) -> None:
    workspace = Workspace()
    valid = pose.project(pose.encode(poses), workspace)
    _require_close(pose.decode(valid), poses, "project leaves valid poses alone")
    astray = _astray(pose, poses)
    before = {group: param.clone() for group, param in astray.items()}
    once = pose.project(astray, workspace)
    require(all(torch.equal(astray[group], before[group]) for group in before), "project leaves its input alone")
    T = pose.decode(once)
    require(bool(is_rigid(T).all()), "project gives rigid transforms")
    position, slack = T[..., :3, 3], TOLERANCE[torch.float32]
    inside = (position >= workspace.minimum - slack) & (position <= workspace.maximum + slack)
    require(bool(inside.all()), "project ends in the workspace")
    _require_close(pose.decode(pose.project(once, workspace)), T, "project is idempotent")


def _check_gradients(pose: Any, poses: Tensor) -> None:
    params = pose.encode(poses)
    groups = sorted(params)
    values = [params[group].detach().clone().requires_grad_() for group in groups]
    try:
        torch.autograd.gradcheck(lambda *given: pose.decode(dict(zip(groups, given, strict=True))), values)
    except Exception as error:  # gradcheck raises a GradcheckError; decode may raise anything
        cause = " ".join(str(error).split())[:300]
        raise ConformanceError(f"decode's gradients disagree with finite differences: {cause}") from error


def _astray(pose: Any, poses: Tensor) -> dict[str, Tensor]:
    """Returns parameters of poses metres away, moved off whatever manifold valid ones lie on."""
    far = torch.cat([poses[..., :3], poses[..., 3:] * 10], dim=-1)
    far[..., 3, 3] = 1.0
    generator = torch.Generator().manual_seed(1)
    noise = {g: torch.randn(p.shape, generator=generator).to(p) for g, p in sorted(pose.encode(far).items())}
    return {group: param + 0.1 * noise[group] for group, param in pose.encode(far).items()}


def _require_close(found: Tensor, expected: Tensor, requirement: str) -> None:
    require(found.shape == expected.shape, f"{requirement}: shape {tuple(found.shape)} for {tuple(expected.shape)}")
    require(found.dtype == expected.dtype, f"{requirement}: {found.dtype} for {expected.dtype}")
    error = (found - expected).abs().flatten()
    off = float(error.nan_to_num(math.inf).max()) if len(error) else 0.0
    require(off <= TOLERANCE[expected.dtype], f"{requirement} in {expected.dtype}: off by {off:.2g}")
