"""What the checks of all groups share."""

import inspect


class ConformanceError(AssertionError):
    """A plug-in violates a requirement of its group."""


def require(condition: bool, requirement: str) -> None:
    """Raises a ConformanceError that states the requirement unless the condition holds."""
    if not condition:
        raise ConformanceError(f"not met: {requirement}")


def require_call(owner: object, name: str, *args: object, **kwargs: object) -> None:
    """Requires that `owner.name(*args, **kwargs)` matches the signature; the function is not called."""
    function = getattr(owner, name, None)
    given = ", ".join([*map(str, args), *(f"{key}=..." for key in kwargs)])
    if not callable(function):
        raise ConformanceError(f"not met: `{name}({given})` exists")
    try:
        inspect.signature(function).bind(*args, **kwargs)
    except TypeError as error:
        raise ConformanceError(f"not met: `{name}({given})` can be called: {error}") from error
