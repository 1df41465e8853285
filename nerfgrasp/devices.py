"""Finding the device to compute on."""

import torch

from nerfgrasp.errors import UserError, unknown_name

_KINDS = ("cpu", "cuda", "mps")


def find_device(name: str | torch.device) -> torch.device:
    """Returns a device that exists on this machine.

    Example:
        >>> find_device("cpu")
        device(type='cpu')

    Args:
        name: `cpu`, `cuda`, `mps`, or a numbered one, e.g. `cuda:1`.

    Raises:
        UserError: the name is unknown, or this machine has no such device.
    """
    kind, _, number = str(name).partition(":")
    if kind not in _KINDS or (number and not number.isdecimal()):
        raise unknown_name("device", str(name), _KINDS)
    found = {"cpu": 1, "cuda": torch.cuda.device_count(), "mps": int(torch.backends.mps.is_available())}[kind]
    if int(number or 0) >= found:
        raise UserError(f"device {str(name)!r} is not there: PyTorch finds {found} of the kind {kind!r}")
    return torch.device(str(name))
