"""The check of grippers."""

import re
from typing import Any

from nerfgrasp.grippers import Gripper
from nerfgrasp.testing.conformance import require


def check_gripper(gripper: Any) -> None:
    """Checks a gripper: an object of the class `nerfgrasp.grippers.Gripper`, which validates its own dimensions.

    Raises:
        ConformanceError: it has another type, or a name that files and results cannot hold.
    """
    require(isinstance(gripper, Gripper), f"a gripper is an object of the class Gripper, not {gripper!r}")
    name = gripper.name
    require(bool(re.fullmatch(r"[A-Za-z0-9_.-]+", name)), f"a name has only letters, digits, _, . and -, not {name!r}")
