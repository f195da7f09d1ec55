"""Short turns on the processor: a thread that wakes runs at once, though others use every core.

Linux's scheduler (EEVDF, since 6.6) lets a running thread finish its turn of some 3 ms before one that has
just woken, unless that one's own turns are shorter: then its deadline is earlier. Since 6.12 a thread may say
how long its turns are (sched_setattr(2), `sched_runtime` under SCHED_OTHER, 0.1 to 100 ms). It needs no
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
# The number of the system call, which the C library has no function for.
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "armv7l": 380, "riscv64": 274}
_SCHED_OTHER = 0
# struct sched_attr, first version: size, policy, flags, nice, priority, runtime, deadline, period.
_SCHED_ATTR = struct.Struct("=IIQiIQQQ")


def set_scheduler_slice(turn_ns: int = SHORTEST_NS) -> bool:
    """Ask for it, for the thread that calls. False: this system knows nothing of it; nothing has changed."""
    number = _SCHED_SETATTR.get(platform.machine())
    if not sys.platform.startswith("linux") or number is None:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = _SCHED_ATTR.pack(_SCHED_ATTR.size, _SCHED_OTHER, 0, nice, 0, turn_ns, 0, 0)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(number, 0, ctypes.create_string_buffer(attributes, _SCHED_ATTR.size), 0) == 0:
        return True
    logger.debug("no short turns on the processor: %s", os.strerror(ctypes.get_errno()))
    return False
