"""A parameterization that breaks its word is named before the search relies on it."""

from collections.abc import Callable
from importlib.metadata import EntryPoint
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfgrasp import registry
from nerfgrasp.errors import UserError
from nerfgrasp.scenes.scene import Workspace
from nerfgrasp.search import ascend, random_candidates
from nerfgrasp.search.limits import Limits
from nerfgrasp.search.parameterization import load_pose

Params = dict[str, Any]


class Good:
    """The matrix itself; steps that leave the rigid transforms are another's trouble."""

    def encode(self, T: Tensor) -> Params:
        return {"pose": T.flatten(-2)}

    def decode(self, params: Params) -> Any:
        return params["pose"].unflatten(-1, (4, 4))

    def project(self, params: Params, workspace: Workspace) -> Params:
        T = params["pose"].unflatten(-1, (4, 4)).clone()
        T[..., :3, 3] = T[..., :3, 3].clamp(workspace.minimum, workspace.maximum)
        return {"pose": T.flatten(-2)}


def shifted(T: Tensor) -> Tensor:
    """Poses half a centimetre aside."""
    return T + 0.005 * torch.nn.functional.one_hot(torch.tensor(3), 16).view(4, 4)


def few(T: Tensor) -> Tensor:
    """Poses, if there are no more than five."""
    if len(T) > 5:
        raise ValueError("too many")
    return T


def bad(**methods: Callable[..., Any]) -> Any:
    return type("Bad", (Good,), {name: lambda self, *args, do=do: do(*args) for name, do in methods.items()})()


def test_one_that_keeps_its_word_is_returned(workspace: Workspace) -> None:
    good = Good()
    assert load_pose(good, workspace).pose is good
    with torch.no_grad():
        assert load_pose(good, workspace).pose is good


@pytest.mark.parametrize("name", registry.names(registry.POSES))
def test_all_that_are_registered_are_let_in(name: str, workspace: Workspace) -> None:
    load_pose(name, workspace)
    load_pose(name, Workspace(workspace.minimum + 7, workspace.maximum + 7))


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (bad(encode=lambda T: T), "encode gives a Tensor, not tensors by group"),
        (bad(encode=lambda T: {"pose": [1.0]}), "encode gives a list for 'pose', not a tensor"),
        (bad(encode=lambda T: {"poses": T.flatten(-2)}), r"encode gives the groups \['poses'\]"),
        (bad(encode=lambda T: {"pose": T[0]}), r"encode gives 'pose' of shape \[4, 4\] for 3 poses"),
        (bad(encode=lambda T: {"pose": T.flatten(-2).long()}), "which has no gradients"),
        (bad(encode=lambda T: {"pose": T.flatten(-2) / 0}), "encode gives numbers in 'pose' that are not finite"),
        (bad(project=lambda p, w: {}), r"project gives the groups \[\], not \['pose'\]"),
        (
            bad(project=lambda p, w: {"pose": p["pose"][:2]}),
            r"project gives 'pose' of shape \[2, 16\] .* not \[3, 16\]",
        ),
        (bad(project=lambda p, w: None), "project gives a NoneType, not tensors by group"),
        (bad(decode=lambda p: p["pose"]), r"decode gives \[3, 16\] for 3 poses, not \[3, 4, 4\]"),
        (bad(decode=lambda p: 1.0), "decode gives a float, not a tensor"),
        (bad(decode=lambda p: 2 * Good().decode(p)), "no rigid transform"),
        (bad(decode=lambda p: Good().decode(p) * torch.nan), "not finite"),
        (bad(decode=lambda p: Good().decode(p).detach()), "without a gradient"),
        (bad(decode=lambda p: {}["pose"]), "Bad fails: KeyError: 'pose': the plug-in is at fault"),
        (bad(encode=lambda T: {"pose": T.flatten(-2).double()}), "'pose' of torch.float64 for poses of torch.float32"),
        (bad(decode=lambda p: Good().decode(p).double()), "decode gives torch.float64 for parameters of torch.float32"),
        (bad(project=lambda p, w: {"pose": p["pose"].double()}), "turns 'pose' of torch.float32 into torch.float64"),
        (bad(decode=lambda p: Good().decode({"pose": p["pose"].view(3, 16)})), "Bad fails: RuntimeError"),
        (bad(decode=lambda p: shifted(Good().decode(p))), "decode gives other poses than were encoded"),
        (bad(project=lambda p, w: {"pose": shifted(Good().decode(p)).flatten(-2)}), "project moves valid poses"),
        (bad(project=lambda p, w: p), "project leaves positions outside of the workspace"),
    ],
)
def test_one_that_does_not_is_named(pose: Any, message: str, workspace: Workspace) -> None:
    with pytest.raises(UserError, match=message) as caught:
        load_pose(pose, workspace)
    assert "pose parameterization Bad" in str(caught.value)
    assert "the plug-in is at fault" in str(caught.value)


def test_one_that_breaks_its_word_in_the_climb_is_named(workspace: Workspace) -> None:
    start = random_candidates(8, workspace, torch.Generator().manual_seed(0))
    whole = {"pose": start.flatten(-2)}
    for methods, message in (
        ({"decode": lambda p: few(Good().decode(p))}, "fails: ValueError: too many"),
        ({"decode": lambda p: Good().decode(p)[:5]}, r"decode gives \[5, 4, 4\] for 8 poses, not \[8, 4, 4\]"),
        ({"project": lambda p, w: {"pose": Good().project(p, w)["pose"][:5]}}, r"project gives .* for 8 poses"),
        ({"encode": lambda T: {"pose": few(T).flatten(-2)}}, "fails: ValueError: too many"),
    ):
        pose = load_pose(bad(**methods), workspace)  # five at most are tried
        with pytest.raises(UserError, match=f"pose parameterization Bad.*{message}.*: the plug-in is at fault"):
            ascend(lambda T: T[:, 0, 3], start, pose, workspace, limits=Limits())
    assert load_pose(Good(), workspace).decode(whole).shape == (8, 4, 4)


class Registered(Good):
    def decode(self, params: Params) -> Any:
        return params["pose"]


class Broken(Good):
    def __init__(self) -> None:
        raise RuntimeError("no such table")


@pytest.mark.parametrize(
    ("name", "message"),
    [("Registered", r"decode gives \[3, 16\]"), ("Broken", "fails: RuntimeError: no such table")],
)
def test_a_registered_one_is_named_with_its_distribution(
    name: str, message: str, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = registry.Entry(registry.POSES, name, f"far.away:{name}", "far-away", "3.2")
    monkeypatch.setattr(registry, "entries", lambda group: [entry])
    monkeypatch.setattr(EntryPoint, "load", lambda self: globals()[self.name])
    with pytest.raises(UserError, match=rf"pose '{name}' \(far.away:{name} of far-away 3.2\).*{message}"):
        load_pose(name, workspace)


def test_an_unknown_name_lists_near_misses(workspace: Workspace) -> None:
    with pytest.raises(UserError, match="unknown pose 'quaternoin': did you mean 'quaternion'"):
        load_pose("quaternoin", workspace)
