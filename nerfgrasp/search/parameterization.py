"""Pose parameterizations by name, tried on a few poses before a search relies on them, and watched in it."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import is_rigid
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.candidates import random_candidates
from nerfgrasp.search.schedule import GROUPS, PoseParameterization

DEFAULT_POSE = "quaternion"
"""The parameterization of a search that is given none."""
_TRIED = (3, 1, 5)
"""Poses at once; the first is neither of the sizes 4 and 1, which could hide a mix-up."""
_SLACK = 1e-4
"""Metres, or entries of a rotation, by which rounding may move a pose."""


class Watched:
    """A parameterization whose every answer is looked at, so that what breaks its word is told as its fault.

    Args:
        pose: the parameterization.
        name: what errors call it.
    """

    def __init__(self, pose: PoseParameterization, name: str) -> None:
        self.pose, self.name = pose, name

    def encode(self, T: Tensor) -> dict[str, Tensor]:
        """As the parameterization's; an exception or another shape is a UserError."""
        with _blaming(self.name):
            params = self.pose.encode(T)
            _check_encoded(params, T)
            return params

    def decode(self, params: dict[str, Tensor]) -> Tensor:
        """As the parameterization's; an exception or another shape is a UserError."""
        with _blaming(self.name):
            T = self.pose.decode(params)
            _check_decoded(T, next(iter(params.values())))
            return T

    def project(self, params: dict[str, Tensor], workspace: Workspace) -> dict[str, Tensor]:
        """As the parameterization's; an exception or another shape is a UserError."""
        with _blaming(self.name):
            projected = self.pose.project(params, workspace)
            _check_projected(projected, params)
            return projected


def load_pose(pose: str | PoseParameterization, workspace: Workspace) -> Watched:
    """Returns a parameterization that keeps its word on a few random poses in a workspace, on its device.

    Those are too few to know it by, so it is watched from then on.

    Args:
        pose: a registered name, or an instance.
        workspace: where the search will be.

    Raises:
        UserError: there is none of that name, or it fails, or gives what is no tensor, of another shape or kind, not
            finite, no pose, another pose than it was given, or one outside of the workspace; the message names the
            plug-in and its distribution.
    """
    make = registry.load(registry.POSES, pose) if isinstance(pose, str) else lambda: pose
    name = _name(pose)
    with _blaming(name):
        found: PoseParameterization = make()
        for count in _TRIED:
            _try(found, random_candidates(count, workspace, torch.Generator().manual_seed(0)), workspace)
        return Watched(found, name)


def _name(pose: str | PoseParameterization) -> str:
    if isinstance(pose, str):
        return f"pose {pose!r} ({registry.find(registry.POSES, pose)})"
    return f"pose parameterization {type(pose).__name__}"


class _FaultError(Exception):
    """What a plug-in does wrong."""


@contextmanager
def _blaming(name: str) -> Iterator[None]:
    """Turns whatever a stranger's code raises, or does wrong, into a UserError that names it."""
    try:
        yield
    except UserError:
        raise
    except _FaultError as fault:
        raise UserError(f"{name}: {fault}: the plug-in is at fault") from None
    except Exception as error:
        cause = f"{type(error).__name__}: {error}"
        raise UserError(f"{name} fails: {cause}: the plug-in is at fault") from error


def _try(pose: PoseParameterization, T: Tensor, workspace: Workspace) -> None:
    """Checks, on poses `[P, 4, 4]` inside of the workspace, all that holds of the answers to them."""
    params = pose.encode(T)
    _check_encoded(params, T)
    _check_finite("encode", params)
    projected = pose.project(params, workspace)
    _check_projected(projected, params)
    _check_finite("project", projected)
    free = {group: param.detach().clone().requires_grad_() for group, param in params.items()}
    with torch.enable_grad():
        decoded = pose.decode(free)
    _check_decoded(decoded, T)
    _require(bool(is_rigid(decoded.detach()).all()), "decode gives what is no rigid transform, or not finite")
    _require(decoded.requires_grad, "decode gives a tensor without a gradient")
    with torch.enable_grad():
        total = decoded.square().sum() + decoded.sum()
    gradients = torch.autograd.grad(total, list(free.values()), allow_unused=True)
    for group, gradient in zip(free, gradients, strict=True):
        finite = gradient is not None and bool(gradient.isfinite().all())
        _require(finite, f"decode has no finite gradient in {group!r}")
    _try_poses(pose, T, decoded.detach(), workspace)


def _try_poses(pose: PoseParameterization, T: Tensor, decoded: Tensor, workspace: Workspace) -> None:
    """Checks where poses `[P, 4, 4]` come out: decoded, and projected from inside and outside of the workspace."""
    _require(_close(decoded, T), "decode gives other poses than were encoded")
    _require(_close(pose.decode(pose.project(pose.encode(T), workspace)), T), "project moves valid poses")
    low, high = workspace.minimum.to(T), workspace.maximum.to(T)
    astray = T.clone()
    astray[:, :3, 3] += 2 * torch.where(T[:, :3, 3] > (low + high) / 2, high - low, low - high)
    position = pose.decode(pose.project(pose.encode(astray), workspace))[:, :3, 3]
    inside = (position >= low - _slack(low)) & (position <= high + _slack(high))
    _require(bool(inside.all()), "project leaves positions outside of the workspace")


def _close(found: Tensor, expected: Tensor) -> bool:
    return bool(((found - expected).abs() <= _slack(expected)).all())


def _slack(expected: Tensor) -> Tensor:
    """Returns by how much rounding may move numbers: metres far away are rounded more."""
    return _SLACK * expected.abs().amax().clamp(min=1.0)


def _check_encoded(params: Any, T: Tensor) -> None:
    _check_params("encode", params)
    _require(set(params) in GROUPS, f"encode gives the groups {sorted(params)}, not position and orientation, or pose")
    for group, param in params.items():
        fits = param.ndim >= 2 and len(param) == len(T)
        given = f"{group!r} of shape {list(param.shape)} for {len(T)} poses"
        _require(fits, f"encode gives {given}, not [{len(T)}, ...]")
        _require(param.is_floating_point(), f"encode gives {group!r} of {param.dtype}, which has no gradients")
        _require(param.dtype == T.dtype, f"encode gives {group!r} of {param.dtype} for poses of {T.dtype}")


def _check_projected(projected: Any, params: Mapping[str, Tensor]) -> None:
    _check_params("project", projected)
    groups = f"project gives the groups {sorted(projected)}, not {sorted(params)}"
    _require(projected.keys() == params.keys(), groups)
    for group, param in projected.items():
        before = params[group]
        given = f"{group!r} of shape {list(param.shape)} for {len(before)} poses"
        _require(param.shape == before.shape, f"project gives {given}, not {list(before.shape)}")
        _require(param.dtype == before.dtype, f"project turns {group!r} of {before.dtype} into {param.dtype}")


def _check_decoded(T: Any, of: Tensor) -> None:
    """Checks what `decode` gives for as many poses as `of` `[P, ...]` has, and of its kind."""
    _require(isinstance(T, Tensor), f"decode gives a {type(T).__name__}, not a tensor")
    expected = [len(of), 4, 4]
    _require(list(T.shape) == expected, f"decode gives {list(T.shape)} for {len(of)} poses, not {expected}")
    _require(T.dtype == of.dtype, f"decode gives {T.dtype} for parameters of {of.dtype}")


def _check_params(step: str, params: Any) -> None:
    _require(isinstance(params, Mapping), f"{step} gives a {type(params).__name__}, not tensors by group")
    for group, param in params.items():
        _require(isinstance(param, Tensor), f"{step} gives a {type(param).__name__} for {group!r}, not a tensor")


def _check_finite(step: str, params: Mapping[str, Tensor]) -> None:
    for group, param in params.items():
        _require(bool(param.isfinite().all()), f"{step} gives numbers in {group!r} that are not finite")


def _require(kept: bool, fault: str) -> None:
    if not kept:
        raise _FaultError(fault)
