"""The perception worker seen from the service: one process, the sockets to it, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from typing import Self

from companion.perception.messages import (
    Attitude,
    Begin,
    GimbalAttitude,
    Hud,
    Message,
    Stop,
    Watched,
    packed,
    read_message,
)
from companion.settings import Settings

logger = logging.getLogger(__name__)

# Results that wait in the kernel are old before they are read: room for about ten, no more.
_SEND_BUFFER_BYTES = 16384
# Above this much that the worker has not taken (it is stopped, or busy) no more lines for the video go there.
_UNREAD_BYTES = 65536
# What a worker and its libraries print: a traceback goes through, a flood is cut.
_PRINTED_LINES_PER_S, _PRINTED_LINE_BYTES = 100, 1000
# At its death the last lines may take so long to be read.
_LAST_LINES_S = 0.5


class PerceptionProcess:
    """A worker that was started. Make one with `spawn`.

    What it says and what it is told go by sockets of their own: to write to a worker that has just ended
    fails, and asyncio then closes that socket with all that was not read yet, the last words among it.
    """

    def __init__(
        self,
        process: asyncio.subprocess.Process,
        reports: tuple[asyncio.StreamReader, asyncio.StreamWriter],
        control: tuple[asyncio.StreamReader, asyncio.StreamWriter],
        printed: int,
    ) -> None:
        self._process = process
        self._reports = reports[0]
        self._orders = control[1]
        self._ends = (reports[1], control[1])
        self._printing = threading.Thread(
            target=log_printed, args=(printed, process.pid), name="worker's standard error", daemon=True
        )
        self._printing.start()

    @classmethod
    async def spawn(cls, settings: Settings, standard_input: int, first_track_id: int = 1) -> Self:
        """Start a fresh interpreter that has nothing of this one but the search path.

        Args:
            standard_input: the descriptor that becomes the worker's, or `subprocess.DEVNULL`.
            first_track_id: the number of its first track.

        Raises:
            OSError: no more processes or descriptors.
        """
        said, saying = socket.socketpair()
        told, telling = socket.socketpair()
        # Not our own standard error: where nobody reads that, the worker would stop at its next line.
        printed, printing = os.pipe()
        with saying, told, contextlib.ExitStack() as always, contextlib.ExitStack() as failing:
            always.callback(os.close, printing)
            failing.callback(os.close, printed)
            failing.enter_context(said)
            failing.enter_context(telling)
            saying.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            reports = await asyncio.open_connection(sock=said)
            failing.callback(reports[1].close)
            control = await asyncio.open_connection(sock=telling)
            failing.callback(control[1].close)
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",  # the search path below, and not the working directory, says what is imported
                "-m",
                "companion.perception.worker",
                str(saying.fileno()),
                str(told.fileno()),
                str(os.getpid()),
                pass_fds=(saying.fileno(), told.fileno()),
                stdin=standard_input,
                stdout=printing,
                stderr=printing,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                # A Ctrl-C in the terminal is for the service, which then asks the worker to end.
                process_group=0,
            )
            failing.pop_all()
        worker = cls(process, reports, control, printed)
        worker._put(Begin(settings, first_track_id))
        return worker

    @property
    def pid(self) -> int:
        return self._process.pid

    async def read(self) -> Message | None:
        """The next message; None when the worker has closed its end, which it does by dying too."""
        return await read_message(self._reports)

    def show(self, hud: Hud) -> None:
        """Tell what to draw on the recorded video. Left out while the worker takes no orders."""
        if self._orders.transport.get_write_buffer_size() < _UNREAD_BYTES:
            self._put(hud)

    def turn(self, attitude: Attitude | GimbalAttitude) -> None:
        """Tell how vehicle or gimbal was turned. Left out while an older one waits: a newer will come."""
        if not self._orders.transport.get_write_buffer_size():
            self._put(attitude)

    def watch(self, watched: bool) -> None:
        """Tell whether anybody wants pictures."""
        self._put(Watched(watched))

    def ask_to_stop(self) -> None:
        self._put(Stop())

    def terminate(self) -> None:
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        self._signal(signal.SIGKILL)

    def close(self) -> None:
        """Hear and tell nothing more."""
        for end in self._ends:
            end.close()

    async def ends_within(self, timeout_s: float) -> bool:
        """Whether it is dead by then."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._process.wait()
            return True
        return False

    async def wait(self) -> str:
        """Wait for its death; how it died, in words."""
        code = await self._process.wait()
        self.close()
        await asyncio.to_thread(self._printing.join, _LAST_LINES_S)
        for end in self._ends:
            with contextlib.suppress(ConnectionError):
                await end.wait_closed()
        if code >= 0:
            return f"process {self.pid} exited with code {code}"
        try:
            name = signal.Signals(-code).name
        except ValueError:  # a real-time signal has no name
            name = f"signal {-code}"
        return f"process {self.pid} was killed by {name}"

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def _put(self, message: Message) -> None:
        # A write to a worker that is gone is dropped by the transport; its death shows in `read`.
        if not self._orders.is_closing():
            self._orders.write(packed(message))


def log_printed(descriptor: int, pid: int) -> None:
    """Into the log, until its end: what the worker and the libraries in it print."""
    partial, cut, since_s, lines_left = b"", 0, -1.0, 0
    with open(descriptor, "rb", buffering=0) as pipe:
        while data := pipe.read(65536):
            *lines, partial = (partial + data).split(b"\n")
            partial = partial[:_PRINTED_LINE_BYTES]
            if time.monotonic() - since_s >= 1.0:
                if cut:
                    logger.warning("process %d printed %d more lines", pid, cut)
                since_s, lines_left, cut = time.monotonic(), _PRINTED_LINES_PER_S, 0
            cut += max(len(lines) - lines_left, 0)
            for line in lines[:lines_left]:
                logger.warning("%s", line[:_PRINTED_LINE_BYTES].decode(errors="replace").rstrip())
            lines_left = max(lines_left - len(lines), 0)
    if partial:
        logger.warning("%s", partial.decode(errors="replace"))
