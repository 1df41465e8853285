"""Conformance checks for plug-ins, one for each entry-point group.

Plug-in authors call them in their tests; `nerfgrasp plugins list --check` runs them on everything that is installed.
Each takes the registered object, returns None, and raises a `ConformanceError` that names the requirement that failed:

    from nerfgrasp.testing import check_pose

    def test_conformance() -> None:
        check_pose(MyParameterization)
"""

from collections.abc import Callable
from typing import Any

from nerfgrasp.registry import BASELINES, GRIPPERS, POSES
from nerfgrasp.testing.conformance import ConformanceError
from nerfgrasp.testing.grippers import check_gripper
from nerfgrasp.testing.methods import check_baseline
from nerfgrasp.testing.poses import check_pose, sample_poses

__all__ = ["CHECKS", "ConformanceError", "check_baseline", "check_gripper", "check_pose", "sample_poses"]

CHECKS: dict[str, Callable[[Any], None]] = {
    POSES: check_pose,
    BASELINES: check_baseline,
    GRIPPERS: check_gripper,
}
"""The check of each entry-point group."""
