"""The one place that decides what ends a program that flies, and that all of it ends alike.

Ctrl-C, `kill`, a closed terminal or ssh (SIGHUP), and readers of the output that have gone, such as those of
ssh without a terminal, which sends no signal. A second signal changes nothing: the end is on its way.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import stat
from collections.abc import Callable, Coroutine
from typing import TypeVar

from companion.host.journal import is_journal
from companion.host.tasks import spawn

_T = TypeVar("_T")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_OUTPUTS = (1, 2)  # descriptors of standard output and error
_WATCH_S = 0.5


class EndedError(RuntimeError):
    """A signal has ended the work."""


def on_ending(end: Callable[[], object]) -> asyncio.Task[None]:
    """Call `end` for everything that ends the program, from now on, in the running loop.

    Args:
        end: may be called several times.

    Returns:
        The watch over the readers of the output; to be kept until the end.
    """
    loop = asyncio.get_running_loop()
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # `nohup` ignores SIGHUP
            loop.add_signal_handler(number, end)
    return spawn(_watch_readers(end), "readers of the output")


async def until_ended(work: Coroutine[object, object, _T]) -> _T:
    """Run `work`, which everything that ends the program cancels, once. Raises EndedError then."""
    task = asyncio.ensure_future(work)
    ended = False

    def end() -> None:
        nonlocal ended
        if not ended:
            ended = True
            task.cancel()

    watch = on_ending(end)
    try:
        return await task
    except asyncio.CancelledError:
        if ended:
            raise EndedError("ended by a signal") from None
        raise
    finally:
        watch.cancel()


async def _watch_readers(end: Callable[[], object]) -> None:
    """Call `end` once the reader of an output has gone."""
    watched = select.poll()
    for descriptor in _with_readers():
        watched.register(descriptor, 0)
    gone = select.POLLERR | select.POLLHUP
    while True:
        await asyncio.sleep(_WATCH_S)
        if any(event & gone for _, event in watched.poll(0)):
            end()
            return


def _with_readers() -> list[int]:
    """The outputs to watch: not the sockets of systemd's journal, which may restart."""
    found = dict[int, os.stat_result]()
    for descriptor in _OUTPUTS:
        with contextlib.suppress(OSError):  # closed
            found[descriptor] = os.fstat(descriptor)
    to_journal = any(map(is_journal, found))
    return [number for number, each in found.items() if not (to_journal and stat.S_ISSOCK(each.st_mode))]
