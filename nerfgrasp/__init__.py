"""6-DoF grasp poses from RGB images: a multi-view NeRF, a grasp value on top of it, and gradient ascent.

`GraspFinder`, `find_strategy` and `UserError` are the Python interface; see docs/search.md.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nerfgrasp.errors import UserError
    from nerfgrasp.methods.finder import GraspFinder
    from nerfgrasp.search.strategies import find_strategy

__version__ = "0.1.0"
__all__ = ["GraspFinder", "UserError", "__version__", "find_strategy"]

_HOMES = {
    "GraspFinder": "nerfgrasp.methods.finder",
    "UserError": "nerfgrasp.errors",
    "find_strategy": "nerfgrasp.search.strategies",
}
"""Where what is imported on first use comes from: the command answers at once only if nothing heavy comes along."""


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
