"""What a module says of itself so that a model folder can hold it, a plug-in's too."""

from typing import Any, ClassVar

from torch import nn


class StoredModule(nn.Module):
    """A module that is built from its config alone, `type(module)(config)`; its weights are loaded into it."""

    kind: ClassVar[str]
    """What `config.json` calls it."""
    config_class: ClassVar[type[Any]]
    """A frozen dataclass of plain values, nested ones too."""
    method: ClassVar[str | None] = None
    """The registered name of the grasping method that its folder serves; None if it finds no grasps."""
    config: Any
    """Its config, of `config_class`."""
