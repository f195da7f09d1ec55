"""The scheduler slice of a thread, as the kernel has it (sched_getattr(2))."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import struct

_SCHED_GETATTR = {"x86_64": 315, "aarch64": 275}
_SCHED_ATTR = struct.Struct("=IIQiIQQQ")


def slice_of(thread: int) -> int | None:
    """Nanoseconds; None before Linux 6.12, or on another processor."""
    release = tuple(int(number) for number in re.findall(r"\d+", os.uname().release)[:2])
    number = _SCHED_GETATTR.get(platform.machine())
    if release < (6, 12) or number is None:
        return None
    buffer = ctypes.create_string_buffer(_SCHED_ATTR.size)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(number, thread, buffer, _SCHED_ATTR.size, 0) != 0:
        raise OSError(ctypes.get_errno(), "sched_getattr")
    return int(_SCHED_ATTR.unpack(buffer.raw)[5])
