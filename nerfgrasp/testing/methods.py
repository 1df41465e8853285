"""The check of grasping methods."""

import inspect
from typing import Any

from nerfgrasp.testing.conformance import ConformanceError, require, require_call

NEEDS = {"depth", "truth"}
"""Inputs that a method may require in addition to RGB images; it declares them in `needs`."""


def check_baseline(method: Any) -> None:
    """Checks a grasping method: a class with `needs`, `from_pretrained(folder)` and `propose(...)`.

    The check covers only what can be verified without a trained model.

    Raises:
        ConformanceError: a requirement is not met.
    """
    require(inspect.isclass(method), f"a method is a class, not {method!r}")
    needs = getattr(method, "needs", None)
    if not isinstance(needs, frozenset):
        raise ConformanceError(f"`needs` is a frozenset, not {needs!r}")
    require(needs <= NEEDS, f"`needs` may hold {sorted(NEEDS)}, not {sorted(map(str, needs - NEEDS))}")
    loader = inspect.getattr_static(method, "from_pretrained", None)
    require(isinstance(loader, classmethod | staticmethod), "`from_pretrained` is a class method that makes the method")
    require_call(method, "from_pretrained", "folder")
    require_call(method, "propose", "self", "observations", "workspace", generator=None)
    require_call(method, "propose", "self", "observations", "workspace", generator=None, count=1)
