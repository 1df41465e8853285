"""One object that says which method is used, and how."""

import json
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class MethodSpec:
    """A method's name, the model folder that it is loaded from, and its options.

    Options are the keyword parameters of the method's `from_pretrained` beyond the folder. An option that is not given
    is not in the dict: the method's default applies.

    Example:
        >>> MethodSpec("psi", options={"strategy": "paper", "pose": None}).options
        {'strategy': 'paper'}
    """

    name: str
    """The registered name."""
    folder: str | None = None
    """The model folder; None for the method's default."""
    options: dict[str, Any] = field(default_factory=dict)
    """JSON values by the option's name; None values are left out."""

    def __post_init__(self) -> None:
        """Leaves out options that are None."""
        given = {name: value for name, value in self.options.items() if value is not None}
        object.__setattr__(self, "options", given)

    def __hash__(self) -> int:
        return hash((self.name, self.folder, json.dumps(self.options, sort_keys=True, default=str)))
