"""What methods without a model share."""

from typing import Self


class Untrained:
    """A method that has learned nothing."""

    @classmethod
    def from_pretrained(cls, folder: str | None = None) -> Self:
        """Returns the method; there is nothing to load, so `folder` is not read."""
        return cls()
