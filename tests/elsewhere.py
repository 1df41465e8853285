"""A device that is not the CPU, for machines that have no other: what reaches it mixes with nothing that did not.

It computes on the CPU and refuses what a GPU does: an operation on tensors of two devices, but for numbers without a
dimension, and (as Apple's) float64. It goes by the name of PyTorch's `meta`, which autograd knows on every machine.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")
_MOVES = ("aten::_to_copy", "aten::copy_")


class DeviceError(Exception):
    """A GPU would have refused."""


class Elsewhere(Tensor):
    """A tensor on that device."""

    here: Tensor
    """What it holds."""

    @staticmethod
    def __new__(cls, here: Tensor) -> "Elsewhere":
        if here.dtype == torch.float64:
            raise DeviceError("a float64 tensor: not every device has them")
        found: Elsewhere = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, here.size(), here.stride(), here.storage_offset(), dtype=here.dtype, device=DEVICE
        )
        found.here = here
        return found

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"Elsewhere({self.here})"

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        return _run(func, args, kwargs or {})


class _Operations(TorchDispatchMode):
    """Sees the operations too that make tensors of nothing, there or here."""

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        return _run(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Does what PyTorch would do for `meta` without any operation, and so without values."""

    def __torch_function__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        named = dict(kwargs or {})
        first = args[0] if args else None
        if func in (torch.tensor, torch.as_tensor) and named.get("device") in (DEVICE, str(DEVICE)):
            return func(*args, **{**named, "device": "cpu"}).to(DEVICE)
        if isinstance(first, Elsewhere):
            if func is Tensor.new_tensor:
                return torch.tensor(*args[1:], **{"dtype": first.dtype, **named}).to(DEVICE)
            if func is Tensor.tolist:
                return first.cpu().tolist()
            if func in (Tensor.__getitem__, Tensor.__setitem__):
                index = args[1] if isinstance(args[1], tuple) else (args[1],)
                sent = tuple(torch.tensor(part).to(DEVICE) if isinstance(part, list) else part for part in index)
                return func(first, sent, *args[2:])
        return func(*args, **named)


def _run(func: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    name = func._schema.name
    tensors = [part for part in tree_flatten((args, kwargs))[0] if isinstance(part, Tensor)]
    given = any(isinstance(tensor, Elsewhere) for tensor in tensors)
    if given and name not in _MOVES and any(not isinstance(tensor, Elsewhere) and tensor.dim() for tensor in tensors):
        shapes = ", ".join(f"{type(tensor).__name__} {list(tensor.shape)}" for tensor in tensors)
        raise DeviceError(f"{name} of tensors on two devices: {shapes}")
    result = func(*tree_map(_here, args), **tree_map(_here, kwargs))
    if func._schema.is_mutable and result is _here(args[0]):
        return args[0]
    device = kwargs.get("device")
    if not (given if device is None else torch.device(device) == DEVICE):
        return result
    return tree_map(lambda part: Elsewhere(part) if isinstance(part, Tensor) else part, result)


def _here(part: Any) -> Any:
    if isinstance(part, Elsewhere):
        return part.here
    return torch.device("cpu") if isinstance(part, torch.device) and part == DEVICE else part


@contextmanager
def another_device() -> Iterator[Callable[[nn.Module], None]]:
    """Yields a function that sends a module there; tensors go by `.to(DEVICE)` while the block lasts."""

    def send(module: nn.Module) -> None:
        for part in module.modules():
            for name, parameter in part._parameters.items():
                if parameter is not None:
                    part._parameters[name] = nn.Parameter(Elsewhere(parameter.detach()), parameter.requires_grad)
            for name, buffer in part._buffers.items():
                part._buffers[name] = None if buffer is None else Elsewhere(buffer)

    def kind(part: object) -> type:
        return Tensor if isinstance(part, Tensor) else type(part)

    # RoMa tells a tensor from a list of angles by its very class, and a device without float64 by Apple's name.
    as_there = {"roma.euler.type": kind, "roma.mappings._supports_float64": lambda device: device != DEVICE}
    with ExitStack() as stack:
        for name, stand_in in as_there.items():
            stack.enter_context(patch(name, stand_in, create=True))
        stack.enter_context(_Functions())
        stack.enter_context(_Operations())
        yield send
