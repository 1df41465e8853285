"""Pose parameterizations by name, tried on a few poses before a search relies on them."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.geometry import is_rigid
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search.candidates import random_candidates
from nerfgrasp.search.schedule import GROUPS, PoseParameterization

_TRIED = 3
"""Poses; neither of the sizes 4 and 1, which could hide a mix-up."""


def load_pose(pose: str | PoseParameterization, workspace: Workspace) -> PoseParameterization:
    """Returns a parameterization that keeps its word on a few random poses in a workspace, on its device.

    Args:
        pose: a registered name, or an instance.
        workspace: where the search will be.

    Raises:
        UserError: there is none of that name, or it fails, or gives what is no tensor, of another shape, not finite
            or no pose; the message names the plug-in and its distribution.
    """
    make = registry.load(registry.POSES, pose) if isinstance(pose, str) else lambda: pose
    try:
        found: PoseParameterization = make()
        _try(found, random_candidates(_TRIED, workspace, torch.Generator().manual_seed(0)), workspace)
    except _FaultError as fault:
        raise UserError(f"{_name(pose)}: {fault}: the plug-in is at fault") from None
    except Exception as error:  # whatever a stranger's code raises
        cause = f"{type(error).__name__}: {error}"
        raise UserError(f"{_name(pose)} fails: {cause}: the plug-in is at fault") from error
    return found


def _name(pose: str | PoseParameterization) -> str:
    if isinstance(pose, str):
        return f"pose {pose!r} ({registry.find(registry.POSES, pose)})"
    return f"pose parameterization {type(pose).__name__}"


class _FaultError(Exception):
    """What a plug-in does wrong."""


def _try(pose: PoseParameterization, T: Tensor, workspace: Workspace) -> None:
    params = pose.encode(T)
    _check_params("encode", params, None)
    _require(set(params) in GROUPS, f"encode gives the groups {sorted(params)}, not position and orientation, or pose")
    shapes = {group: param.shape for group, param in params.items()}
    _check_params("project", pose.project(params, workspace), shapes)
    free = {group: param.detach().clone().requires_grad_() for group, param in params.items()}
    with torch.enable_grad():
        decoded = pose.decode(free)
    _require(isinstance(decoded, Tensor), f"decode gives a {type(decoded).__name__}, not a tensor")
    _require(decoded.shape == T.shape, f"decode gives {list(decoded.shape)} for {len(T)} poses, not {list(T.shape)}")
    _require(bool(is_rigid(decoded.detach()).all()), "decode gives what is no rigid transform, or not finite")
    _require(decoded.requires_grad, "decode gives a tensor without a gradient")
    with torch.enable_grad():
        total = decoded.square().sum() + decoded.sum()
    gradients = torch.autograd.grad(total, list(free.values()), allow_unused=True)
    for group, gradient in zip(free, gradients, strict=True):
        finite = gradient is not None and bool(gradient.isfinite().all())
        _require(finite, f"decode has no finite gradient in {group!r}")


def _check_params(step: str, params: Any, shapes: dict[str, torch.Size] | None) -> None:
    """Checks what `encode` (no shapes to keep) or `project` gives."""
    _require(isinstance(params, Mapping), f"{step} gives a {type(params).__name__}, not tensors by group")
    if shapes is not None:
        _require(params.keys() == shapes.keys(), f"{step} gives the groups {sorted(params)}, not {sorted(shapes)}")
    for group, param in params.items():
        _require(isinstance(param, Tensor), f"{step} gives a {type(param).__name__} for {group!r}, not a tensor")
        if shapes is None:
            fits, expected = param.ndim >= 2 and len(param) == _TRIED, f"[{_TRIED}, ...]"
        else:
            fits, expected = param.shape == shapes[group], str(list(shapes[group]))
        _require(fits, f"{step} gives {group!r} of shape {list(param.shape)} for {_TRIED} poses, not {expected}")
        _require(param.is_floating_point(), f"{step} gives {group!r} of {param.dtype}, which has no gradients")
        _require(bool(param.isfinite().all()), f"{step} gives numbers in {group!r} that are not finite")


def _require(kept: bool, fault: str) -> None:
    if not kept:
        raise _FaultError(fault)
