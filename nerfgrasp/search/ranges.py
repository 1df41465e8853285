"""The check that every number of a search passes: one out of its range is told before anything is computed."""

import math

from nerfgrasp.errors import UserError


def check_number(name: str, value: float | None, least: float, most: float = math.inf, *, above: bool = False) -> None:
    """Checks that a number is finite and within a range; None, which stands for no number, passes.

    Example:
        >>> check_number("keep", 0, 1)
        Traceback (most recent call last):
        nerfgrasp.errors.UserError: keep is 0: it must be at least 1

    Args:
        name: what the number is called.
        value: the number.
        least: the least that it may be, ...
        most: ... and the most.
        above: whether it must lie above `least`.

    Raises:
        UserError: it is out of the range; the message names it.
    """
    if value is None or (math.isfinite(value) and least <= value <= most and not (above and value == least)):
        return
    at_most = f" and at most {most:g}" if math.isfinite(most) else ""
    raise UserError(f"{name} is {value}: it must be {'above' if above else 'at least'} {least:g}{at_most}")
