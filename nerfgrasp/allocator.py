"""Memory that PyTorch frees and asks for again at once stays with the process."""

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # glibc's names in malloc.h


def keep_freed_memory() -> bool:
    """Tells glibc to reuse large freed blocks instead of handing them back to the system.

    On a CPU a training step allocates the same tens of megabytes every time; handed back, each page is zeroed
    and faulted in again, which takes longer than the arithmetic on it. Elsewhere than on Linux with glibc this
    does nothing. Returns whether it took effect; the process keeps its peak of memory from then on.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_THRESHOLD, 1 << 30)) and bool(mallopt(_TRIM_THRESHOLD, (1 << 31) - 1))
