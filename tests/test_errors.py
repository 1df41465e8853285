import pytest

from nerfgrasp.errors import UserError, unknown_name


def test_unknown_name_puts_near_misses_before_all_choices() -> None:
    error = unknown_name("pose", "rotvek", ["rotvec", "quaternion", "matrix"])
    assert isinstance(error, UserError)
    assert str(error) == "unknown pose 'rotvek': did you mean 'rotvec'? (choices: matrix, quaternion, rotvec)"


def test_unknown_name_without_a_near_miss_lists_the_choices() -> None:
    assert str(unknown_name("scene", "xyz", ["demo"])) == "unknown scene 'xyz': (choices: demo)"


@pytest.mark.parametrize("choices", [[], ()])
def test_unknown_name_without_choices_says_so(choices: object) -> None:
    assert str(unknown_name("scene", "demo", choices)) == "unknown scene 'demo': (choices: none)"
