"""What a process has freed and not given back to the system."""

from __future__ import annotations

import ctypes
import sys


def give_back_freed_memory() -> None:
    """Give back to the system what was freed, where the C library can be told to: glibc.

    The images of a C-scan are as large as the C-scan. They come in pieces that the library keeps for later when they
    are freed, while a volume and its message are in one piece each and find no room among them. Takes some
    milliseconds; from any thread.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
