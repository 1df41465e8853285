"""The interface of grasping methods, which the entry-point group `nerfgrasp.baselines` holds."""

from typing import ClassVar, Protocol, runtime_checkable

import torch

from nerfgrasp.scenes.scene import Grasps, Observations, Workspace
from nerfgrasp.search.ascent import Trace


class Method(Protocol):
    """Proposes grasps from observations of a scene.

    A method also has a class method `from_pretrained(folder, *, ...)` that loads it. The keyword parameters beyond the
    folder are the method's options: see `MethodSpec`. A method that holds a `model` (a module) or a `strategy` (a
    `Strategy`) is recorded in results with the hash of each.
    """

    needs: ClassVar[frozenset[str]]
    """The inputs that the method needs in addition to RGB images: a subset of `depth` and `truth`."""

    def propose(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> Grasps:
        """Returns up to `count` grasps, best first."""


@runtime_checkable
class Traceable(Method, Protocol):
    """A method that can show how its candidates ascended."""

    def propose_with_trace(
        self, observations: Observations, workspace: Workspace, *, generator: torch.Generator, count: int = 1
    ) -> tuple[Grasps, Trace]:
        """Returns the grasps of `propose`, and the trace of the ascent that led to them."""
