"""What every pose parameterization promises, checked on the one that is registered."""

from nerfgrasp_template.sixd import SixD

from nerfgrasp import registry
from nerfgrasp.testing import check_pose


def test_the_registered_name_is_this_class() -> None:
    assert registry.load(registry.POSES, "sixd") is SixD


def test_sixd_conforms() -> None:
    check_pose(SixD)
