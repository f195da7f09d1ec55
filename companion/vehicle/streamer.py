"""The dead-man: sends the newest setpoint at a steady rate while, and only while, it is fresh.

Fresh → the setpoint. Expired → a braking setpoint for `brake_s`. Then silence, so that PX4's own
loss-of-offboard failsafe acts (COM_OF_LOSS_T, COM_OBL_RC_ACT); ArduPilot has none: it stops, in GUIDED. The
streamer runs in the same loop as everything else: when that loop hangs or the process is stopped, nothing is
sent, and the autopilot acts in the same way.

Silence is final: PX4 returns to OFFBOARD by itself when setpoints resume. So after a silence long enough for
its failsafe, whatever caused it, nothing is sent until `stop()`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from enum import StrEnum

from companion.host.scheduling import set_scheduler_slice
from companion.vehicle.precise_sleep import Sleep, precise_sleep
from companion.vehicle.setpoint import Setpoint

logger = logging.getLogger(__name__)

DEFAULT_RATE_HZ = 50.0
DEFAULT_BRAKE_S = 0.5
# A gap longer than this in a running stream is a silence. PX4 allows 1 s (COM_OF_LOSS_T); a gap of 0.8 s had
# no effect on a real PX4.
SILENCE_S = 0.8


class StreamState(StrEnum):
    """What the streamer is doing."""

    SILENT = "silent"  # nothing was submitted, or command was given up
    FRESH = "fresh"  # sending the newest setpoint
    BRAKING = "braking"  # the newest setpoint expired; sending a brake
    EXPIRED = "expired"  # there was a silence; nothing is sent until `stop()`


class Streamer:
    """Sends setpoints through `send`, one per tick.

    `tick(now_ns)` is the whole logic and reads no clock; `run()` calls it at `rate_hz`.
    """

    def __init__(
        self,
        send: Callable[[Setpoint], None],
        *,
        rate_hz: float = DEFAULT_RATE_HZ,
        brake_s: float = DEFAULT_BRAKE_S,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleeper: Callable[[], AbstractAsyncContextManager[Sleep]] = precise_sleep,
    ) -> None:
        if not rate_hz > 2.0:
            raise ValueError(f"rate_hz must be above 2 (PX4's minimum), got {rate_hz}")
        self.send = send
        self._period_ns = round(1e9 / rate_hz)
        self._brake_ns = round(brake_s * 1e9)
        self._clock_ns, self._sleeper = clock_ns, sleeper
        self._newest: Setpoint | None = None
        self._state = StreamState.SILENT
        self._sent: Setpoint | None = None
        self._sent_ns: int | None = None
        self.sent_count = 0

    @property
    def state(self) -> StreamState:
        """The state after the last tick."""
        return self._state

    @property
    def last_sent(self) -> Setpoint | None:
        """The setpoint sent last; None before the first."""
        return self._sent

    @property
    def last_sent_ns(self) -> int | None:
        """When it was sent, nanoseconds."""
        return self._sent_ns

    def submit(self, setpoint: Setpoint) -> None:
        """Replace the newest setpoint. Ignored after a silence."""
        if self._state is not StreamState.EXPIRED:
            self._newest = setpoint

    def stop(self) -> None:
        """Give up command: forget the setpoint and send nothing more."""
        self._newest = None
        self._enter(StreamState.SILENT)

    def send_now(self, now_ns: int) -> None:
        """Send the newest setpoint now, between two ticks, if not sent yet. The tick times do not change."""
        if self._newest is not self._sent and self._state is StreamState.FRESH:
            self.tick(now_ns)

    def tick(self, now_ns: int) -> None:
        """Send what is due at `now_ns`."""
        newest = self._newest
        if newest is None or self._state is StreamState.EXPIRED:
            return
        if self._state is StreamState.SILENT and newest.expired(now_ns):
            # We were not in command, so there is nothing to brake: a brake would only take command.
            return
        if self._was_silent(now_ns):
            self._enter(StreamState.EXPIRED)
        elif not newest.expired(now_ns):
            self._enter(StreamState.FRESH)
            self._put(newest, now_ns)
        elif now_ns - newest.deadline_ns <= self._brake_ns:
            self._enter(StreamState.BRAKING)
            self._put(Setpoint.brake(now_ns), now_ns)
        else:
            self._enter(StreamState.EXPIRED)

    async def run(self) -> None:
        """Tick at `rate_hz` until cancelled. Missed ticks are skipped, never sent in a burst."""
        set_scheduler_slice()
        async with self._sleeper() as sleep:
            due_ns = self._clock_ns()
            while True:
                self.tick(self._clock_ns())
                due_ns += self._period_ns
                late_ns = self._clock_ns() - due_ns
                if late_ns > 0:
                    due_ns += (late_ns // self._period_ns + 1) * self._period_ns
                await sleep((due_ns - self._clock_ns()) / 1e9)

    def _was_silent(self, now_ns: int) -> bool:
        """Whether the stream was running and nothing was sent for too long: the loop was blocked."""
        running = self._state in (StreamState.FRESH, StreamState.BRAKING)
        return running and self._sent_ns is not None and now_ns - self._sent_ns > SILENCE_S * 1e9

    def _put(self, setpoint: Setpoint, now_ns: int) -> None:
        self.send(setpoint.leaving(now_ns))
        self._sent, self._sent_ns = setpoint, now_ns
        self.sent_count += 1

    def _enter(self, state: StreamState) -> None:
        if state is self._state:
            return
        if state is StreamState.BRAKING:
            logger.warning("setpoint expired: braking")
        elif state is StreamState.EXPIRED:
            logger.error("no fresh setpoint: sending stopped, the autopilot's failsafe applies")
        self._state = state
