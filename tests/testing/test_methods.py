"""The check of methods."""

import pytest

from nerfgrasp.testing import ConformanceError, check_baseline


class Method:
    needs: frozenset[str] = frozenset({"depth"})

    @classmethod
    def from_pretrained(cls, folder: str) -> "Method":
        return cls()

    def propose(self, observations: object, workspace: object, *, generator: object, count: int = 1) -> None: ...


class NeedsASet(Method):
    needs = {"depth"}  # type: ignore[assignment]


class NeedsTheMoon(Method):
    needs = frozenset({"moon"})


class MadeByAnInstance(Method):
    def from_pretrained(self, folder: str) -> "Method":  # type: ignore[override]
        return self


class WithoutCount(Method):
    def propose(self, observations: object, workspace: object, *, generator: object) -> None:  # type: ignore[override]
        ...


class WithoutProposals:
    needs: frozenset[str] = frozenset()
    from_pretrained = Method.__dict__["from_pretrained"]


def test_check_baseline_passes_a_method() -> None:
    check_baseline(Method)


@pytest.mark.parametrize(
    ("broken", "requirement"),
    [
        (NeedsASet, "`needs` is a frozenset"),
        (NeedsTheMoon, "moon"),
        (MadeByAnInstance, "from_pretrained"),
        (WithoutCount, "count"),
        (WithoutProposals, "propose"),
        (Method(), "a method is a class"),
    ],
)
def test_check_baseline_names_the_violated_requirement(broken: object, requirement: str) -> None:
    with pytest.raises(ConformanceError, match=requirement):
        check_baseline(broken)
