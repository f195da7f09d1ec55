"""A short scheduler slice: a thread that wakes up runs at once, even when others use every core.

Linux's scheduler (EEVDF, since 6.6) lets a running thread finish its slice of some 3 ms before a thread that
has just woken up, unless the latter has a shorter slice: then its deadline is earlier. Since 6.12 a thread
can set its slice (sched_setattr(2), `sched_runtime` under SCHED_OTHER, 0.1 to 100 ms). This needs no
privilege and gives no larger share of the processor.
"""

from __future__ import annotations

import ctypes
import logging
import os
import platform
import struct
import sys

logger = logging.getLogger(__name__)

SHORTEST_NS = 100_000
# System call numbers: the C library has no wrapper.
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "armv7l": 380, "riscv64": 274}
_SCHED_OTHER = 0
# struct sched_attr, first version: size, policy, flags, nice, priority, runtime, deadline, period.
_SCHED_ATTR = struct.Struct("=IIQiIQQQ")


def set_scheduler_slice(slice_ns: int = SHORTEST_NS) -> bool:
    """Set the slice of the calling thread. False: not supported by this system, nothing has changed."""
    number = _SCHED_SETATTR.get(platform.machine())
    if not sys.platform.startswith("linux") or number is None:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = _SCHED_ATTR.pack(_SCHED_ATTR.size, _SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(number, 0, ctypes.create_string_buffer(attributes, _SCHED_ATTR.size), 0) == 0:
        return True
    logger.debug("scheduler slice not set: %s", os.strerror(ctypes.get_errno()))
    return False
