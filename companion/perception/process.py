"""The perception worker as seen from the service: its process, the sockets to it, its watchdog."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import statistics
import sys
import threading
import time
from collections import deque
from typing import Self

from companion.host.scheduling import schedule_as_any_program
from companion.perception.messages import (
    Attitude,
    Begin,
    Detecting,
    GimbalAttitude,
    Hud,
    Message,
    Stop,
    Watched,
    packed,
    read_message,
)
from companion.settings import Settings
from vision.path_planner import PathRequest
from vision.tracking import SelectRequest

logger = logging.getLogger(__name__)

# Results queued in the kernel are outdated when read: space for about ten.
_SEND_BUFFER_BYTES = 16384
# Above this backlog (the worker is stopped or busy) no more overlay lines are sent.
_UNREAD_BYTES = 65536
# Limits of the worker's printed output: a traceback passes, a flood is cut.
_PRINTED_LINES_PER_S, _PRINTED_LINE_BYTES = 100, 1000
# How long the last printed lines may take to be read after its end.
_LAST_LINES_S = 0.5


class PerceptionProcess:
    """A started worker. Create one with `spawn`.

    Reports and control messages use separate sockets: a write to a worker that has just ended fails, and
    asyncio then closes that socket and discards unread data, including the worker's last message.
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
        self._control = control[1]
        self._ends = (reports[1], control[1])
        self._printing = threading.Thread(
            target=log_printed, args=(printed, process.pid), name="worker's standard error", daemon=True
        )
        self._printing.start()

    @classmethod
    async def spawn(
        cls,
        settings: Settings,
        standard_input: int,
        first_track_id: int = 1,
        record_as: str | None = None,
        detecting: Detecting | None = None,
    ) -> Self:
        """Start a new interpreter with this one's module search path.

        Args:
            standard_input: descriptor of the worker's standard input, or `subprocess.DEVNULL`.
            first_track_id, record_as, detecting: as in `Begin`.

        Raises:
            OSError: no more processes or descriptors.
        """
        reports_here, reports_there = socket.socketpair()
        control_there, control_here = socket.socketpair()
        # Not our own standard error: if that is not read, the worker would block at its next line.
        printed, printing = os.pipe()
        with (
            reports_there,
            control_there,
            contextlib.ExitStack() as always,
            contextlib.ExitStack() as failing,
        ):
            always.callback(os.close, printing)
            failing.callback(os.close, printed)
            failing.enter_context(reports_here)
            failing.enter_context(control_here)
            reports_there.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            reports = await asyncio.open_connection(sock=reports_here)
            failing.callback(reports[1].close)
            control = await asyncio.open_connection(sock=control_here)
            failing.callback(control[1].close)
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",  # import from the search path below, not from the working directory
                "-m",
                "companion.perception.worker",
                str(reports_there.fileno()),
                str(control_there.fileno()),
                str(os.getpid()),
                pass_fds=(reports_there.fileno(), control_there.fileno()),
                stdin=standard_input,
                stdout=printing,
                stderr=printing,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                # Ctrl-C in the terminal is for the service, which then stops the worker.
                process_group=0,
            )
            schedule_as_any_program(process.pid)
            failing.pop_all()
        worker = cls(process, reports, control, printed)
        worker._put(Begin(settings, first_track_id, record_as, detecting))
        return worker

    @property
    def pid(self) -> int:
        return self._process.pid

    async def read(self) -> Message | None:
        """Read the next message; None when the worker has closed its end or died."""
        return await read_message(self._reports)

    def send_hud(self, hud: Hud) -> None:
        """Send the overlay of the recorded video; skipped while the worker does not read."""
        if self._control.transport.get_write_buffer_size() < _UNREAD_BYTES:
            self._put(hud)

    def send_attitude(self, attitude: Attitude | GimbalAttitude) -> None:
        """Send an attitude of vehicle or gimbal; skipped while an older one is unsent."""
        if not self._control.transport.get_write_buffer_size():
            self._put(attitude)

    def request_path(self, request: PathRequest) -> None:
        """Send what path to plan, as `send_attitude`."""
        if not self._control.transport.get_write_buffer_size():
            self._put(request)

    def watch(self, watched: Watched) -> None:
        """Send which previews are wanted."""
        self._put(watched)

    def select(self, request: SelectRequest) -> None:
        """Send what to select; a `Selected` answers it."""
        self._put(request)

    def change_detecting(self, detecting: Detecting) -> None:
        """Send what to detect from the next frame on."""
        self._put(detecting)

    def ask_to_stop(self) -> None:
        self._put(Stop())

    def terminate(self) -> None:
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        self._signal(signal.SIGKILL)

    def close(self) -> None:
        """Close the sockets."""
        for end in self._ends:
            end.close()

    async def wait_ended(self, timeout_s: float) -> bool:
        """Wait for its end; False on timeout."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._process.wait()
            return True
        return False

    async def wait(self) -> str:
        """Wait for its end; returns how it ended, as text."""
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
        # A write to a dead worker is dropped by the transport; `read` detects its end.
        if not self._control.is_closing():
            self._control.write(packed(message))


def log_printed(descriptor: int, pid: int) -> None:
    """Log what the worker and its libraries print, until the pipe is closed."""
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


# At most 50 attitudes a second; the tolerance is for the jitter of telemetry at 50 Hz.
ATTITUDE_PERIOD_S, ATTITUDE_JITTER_S = 0.02, 0.005


class RateLimiter:
    """Passes at most 50 attitudes of one series a second."""

    def __init__(self) -> None:
        self._due_ns = 0

    def due(self, stamp_ns: int) -> bool:
        """Whether to send the attitude of this stamp (CLOCK_MONOTONIC ns); if so, schedules the next."""
        if self._due_ns - stamp_ns > ATTITUDE_JITTER_S * 1e9:
            return False
        self._due_ns = max(
            self._due_ns + round(ATTITUDE_PERIOD_S * 1e9), stamp_ns + round(2 * ATTITUDE_JITTER_S * 1e9)
        )
        return True


# Loading torch and a large model from a cold card. The source's open timeout is added.
START_S = 90.0
# The first inference is slow, and the usual duration is not known yet.
FIRST_RESULT_S = 30.0
# From then on: a multiple of the usual step, within these bounds.
USUAL_STEPS, SHORTEST_S, LONGEST_S = 20.0, 3.0, 30.0


class Watchdog:
    """Decides how long one worker may be silent before it is stuck.

    Times are seconds of one monotonic clock.
    """

    def __init__(self, now_s: float, open_timeout_s: float) -> None:
        """`open_timeout_s`: how long the source may take to open."""
        self._message_s = now_s
        self._limit_s = START_S + open_timeout_s
        self._steps_s: deque[float] = deque(maxlen=50)

    def ready(self) -> None:
        """Note that the worker has loaded and opened everything."""
        self._limit_s = FIRST_RESULT_S

    def on_message(self, now_s: float) -> None:
        """Note a message of any kind."""
        self._message_s = now_s

    def on_result(self, step_s: float) -> None:
        """Note a result and its processing time: the limit follows the usual time."""
        self._steps_s.append(step_s)
        usual_s = statistics.median(self._steps_s)
        self._limit_s = min(max(USUAL_STEPS * usual_s, SHORTEST_S), LONGEST_S)

    def reset(self, now_s: float) -> None:
        """Restart the silence: messages could not be read until now."""
        self._message_s = now_s

    @property
    def stuck_after_s(self) -> float:
        """The present limit of silence."""
        return self._limit_s

    def silent_s(self, now_s: float) -> float:
        """Time since the last message."""
        return now_s - self._message_s
