"""Every registered plug-in keeps the promises of its group."""

import pytest

from nerfgrasp import registry
from nerfgrasp.testing import CHECKS

REGISTERED = [(entry.group, entry.name) for group in registry.GROUPS for entry in registry.entries(group)]


def test_every_group_has_a_check() -> None:
    assert set(CHECKS) == set(registry.GROUPS)


@pytest.mark.parametrize(("group", "name"), REGISTERED)
def test_conforms(group: str, name: str) -> None:
    CHECKS[group](registry.load(group, name))
