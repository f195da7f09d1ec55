"""The scheduling of the service and of the programs it starts.

Linux's scheduler (EEVDF, since 6.6) lets a running thread finish its slice of some 3 ms before a thread that
has just woken up, unless the latter has a shorter slice: then its deadline is earlier. Since 6.12 a thread
can set its slice (sched_setattr(2), `sched_runtime` under SCHED_OTHER, 0.1 to 100 ms). This needs no
privilege and gives no larger share of the processor. New threads and processes inherit it.

The service may have a real-time policy; the programs it starts have that of any program.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import platform
import struct
import sys

logger = logging.getLogger(__name__)

SHORTEST_NS = 100_000
# The kernel's own slice: 0.7 to 2.8 ms, by the number of cores.
DEFAULT_NS = 0
# System call numbers: the C library has no wrapper.
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274, "armv7l": 380, "riscv64": 274}
_SCHED_OTHER = 0
# struct sched_attr, first version: size, policy, flags, nice, priority, runtime, deadline, period.
_SCHED_ATTR = struct.Struct("=IIQiIQQQ")


def set_scheduler_slice(slice_ns: int = SHORTEST_NS, thread: int = 0) -> bool:
    """Set the slice of a thread (0: this one). False: not supported by this system, nothing has changed.

    A thread of another policy than SCHED_OTHER keeps it: a real-time one needs no short slice.
    """
    number = _SCHED_SETATTR.get(platform.machine())
    if not sys.platform.startswith("linux") or number is None:
        return False
    if os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK != os.SCHED_OTHER:
        return True
    nice = os.getpriority(os.PRIO_PROCESS, thread)
    attributes = _SCHED_ATTR.pack(_SCHED_ATTR.size, _SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.syscall(number, thread, ctypes.create_string_buffer(attributes, _SCHED_ATTR.size), 0) == 0:
        return True
    logger.debug("scheduler slice not set: %s", os.strerror(ctypes.get_errno()))
    return False


def schedule_as_any_program(process: int = 0) -> None:
    """Give a process (0: this one) the policy and the slice of any program, instead of those of the service.

    A process inherits those of the thread that starts it. Its parent calls this too: it is at work before it
    can do so itself.
    """
    for thread in _threads(process):
        try:
            if sys.platform.startswith("linux"):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
            set_scheduler_slice(DEFAULT_NS, thread)
        except ProcessLookupError:  # it has ended
            continue
        except OSError as error:
            logger.warning("thread %d keeps the scheduling policy of the service: %s", thread, error.strerror)


def lower_priority(niceness: int) -> None:
    """Lower the priority of this process: of its threads, and of those they start."""
    schedule_as_any_program()
    os.nice(niceness)
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    for thread in _threads():
        with contextlib.suppress(ProcessLookupError):
            os.setpriority(os.PRIO_PROCESS, thread, nice)


def run_when_idle() -> None:
    """Let the other programs of the unit or login session interrupt this process (SCHED_IDLE, sched(7)).

    A program that wakes up waits for the slice of a process of low priority, with 250 ticks a second up to
    4 ms, but never for one of this policy. A busy program on the same core leaves it almost no time.
    """
    for thread in _threads():
        with contextlib.suppress(ProcessLookupError):
            os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))


def _threads(process: int = 0) -> list[int]:
    """The threads of a process: libraries start some as they are imported."""
    if not sys.platform.startswith("linux"):
        return [process]
    try:
        return [int(name) for name in os.listdir(f"/proc/{process or 'self'}/task")]
    except FileNotFoundError:  # it has ended
        return []
