"""Range checks of numbers that a user gives, done before anything is computed."""

import math

from nerfgrasp.errors import UserError


def check_number(
    name: str, value: float | None, minimum: float, maximum: float = math.inf, *, above: bool = False
) -> None:
    """Checks that a number is finite and within a range. None passes: it stands for "not given".

    Example:
        >>> check_number("keep", 0, 1)
        Traceback (most recent call last):
        nerfgrasp.errors.UserError: keep is 0: it must be at least 1

    Args:
        name: the field's name, for the message.
        value: the number.
        minimum: the smallest value allowed.
        maximum: the largest value allowed.
        above: whether the value must be greater than `minimum`, not equal to it.

    Raises:
        UserError: the number is out of range; the message names the field.
    """
    if value is None or (math.isfinite(value) and minimum <= value <= maximum and not (above and value == minimum)):
        return
    at_most = f" and at most {maximum:g}" if math.isfinite(maximum) else ""
    raise UserError(f"{name} is {value}: it must be {'above' if above else 'at least'} {minimum:g}{at_most}")
