"""What the autopilot's messages say, put together into one state; and whoever waits for them is told."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from dataclasses import replace

from companion.vehicle.autopilot_profile import AutopilotProfile, Px4Profile
from companion.vehicle.clock_sync import ClockSync
from companion.vehicle.commander import Commander
from companion.vehicle.gimbal_telemetry import ATTITUDE_STATUS, from_gimbal_device
from companion.vehicle.report import Report
from companion.vehicle.state import HEARTBEAT_MAX_AGE_S, VehicleState
from companion.vehicle.telemetry import Fields, apply_message

logger = logging.getLogger(__name__)

REPORTS_KEPT = 20
_BOOT_TOLERANCE_MS = 1000  # datagrams may overtake each other
# A restart sets the clock back once; so many times within so long are two clocks, heard by turns.
_SETBACKS_OF_TWO = 3
_TWO_CLOCKS_S = 2.0
_BOOTING = 1  # MAV_STATE_BOOT
# They tell the autopilot's clock; of others TIMESYNC and SYSTEM_TIME are watched by the driver.
_CLOCKED = ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ATTITUDE_QUATERNION")
_OF_ITS_PLACE = (*_CLOCKED, "ODOMETRY", "ESTIMATOR_STATUS", ATTITUDE_STATUS)
# PX4 keeps this from when it was first told: its stamp is as old as that, and no fault of the clock.
_OF_LONG_AGO = "GIMBAL_MANAGER_INFORMATION"


class TelemetryState:
    """One autopilot's state as it is heard. Subscribers stay when the link is opened anew.

    Args:
        url: of the link, for the log. on_two: called when two autopilots turn out to speak by turns.

    Attributes:
        state: the newest snapshot.
        profile: the ways of the autopilot that is heard.
        clock: how its time goes with ours.
        mode_ns: when it last showed its mode, CLOCK_MONOTONIC.
        restarted: set when its clock began anew; whoever has dealt with that clears it.
    """

    def __init__(self, url: object, on_two: Callable[[], None]) -> None:
        self._url, self._on_two = url, on_two
        self._subscribers: dict[object, Callable[[VehicleState], None]] = {}
        self._watchers: dict[object, Callable[[str, Fields], None]] = {}
        self.reset()

    def reset(self) -> None:
        """Nothing has been heard yet."""
        self.state = VehicleState()
        self.profile: AutopilotProfile = Px4Profile()
        self.clock = ClockSync()
        self.mode_ns = 0
        self.restarted = asyncio.Event()
        self._boot_ms: dict[str, int] = {}
        self._booting = False
        self._setbacks_ns: deque[int] = deque(maxlen=_SETBACKS_OF_TWO)
        self._two_heard_ns = 0

    def handle(self, name: str, fields: Fields) -> None:
        """One message of the autopilot: into the state, and to whoever waits for it."""
        for told, its_fields in self.profile.translate(name, fields, self.state):
            self.take_in(told, its_fields)

    def handle_device(self, name: str, fields: Fields, component_id: int) -> None:
        """One message of another component of the vehicle: a gimbal's attitude, or nothing to us."""
        if from_gimbal_device(self.state, name, component_id):
            # Its clock is its own: what it tells is stamped at its arrival.
            self.take_in(name, {key: value for key, value in fields.items() if key != "time_boot_ms"})

    def take_in(self, name: str, fields: Fields) -> None:
        """One message in PX4's terms."""
        now_ns = time.monotonic_ns()
        if name in _CLOCKED:
            self.watch_clock(name, fields["time_boot_ms"], now_ns)
        elif name == "HEARTBEAT":
            self._watch_booting(fields["system_status"] == _BOOTING)
        if name in ("HEARTBEAT", "CURRENT_MODE"):
            self.mode_ns = now_ns
        if name in _OF_ITS_PLACE and self.two_autopilots(now_ns):
            return  # Nobody can tell whose it is: what is known grows stale, and what needs it ends.
        stamped = "time_boot_ms" in fields and name != _OF_LONG_AGO
        stamp_ns = self.clock.stamp(fields["time_boot_ms"], now_ns) if stamped else now_ns
        state = apply_message(self.state, name, fields, stamp_ns)
        if (
            state.reset_count != self.state.reset_count
            or state.position_valid is not self.state.position_valid
        ):
            self._report_estimate(state)
        self._show(state, name, fields)

    def _report_estimate(self, state: VehicleState) -> None:
        """Into the log: the estimate was reset, or is valid or not from now on."""
        if state.reset_count != self.state.reset_count:
            logger.warning("%s: the position estimate was %s", self._url, state.reset_words(self.state))
        elif state.position_valid is False:
            logger.warning("%s: the position estimate is not valid", self._url)
        elif self.state.position_valid is False:
            logger.info("%s: the position estimate is valid again", self._url)

    def take_report(self, report: Report | None) -> None:
        """Something it said in words; None: nothing."""
        if report is not None:
            reports = (*self.state.reports, report)[-REPORTS_KEPT:]
            self._show(replace(self.state, reports=reports), "REPORT", {"report": report})

    def take_commander(self, commander: Commander) -> None:
        """A heartbeat of another service on the same vehicle."""
        others = (one for one in self.state.other_commanders if one.address != commander.address)
        self._show(replace(self.state, other_commanders=(*others, commander)), "COMMANDER", {})

    def _show(self, state: VehicleState, name: str, fields: Fields) -> None:
        """The state after a message, to whoever waits for it."""
        changed, self.state = state is not self.state, state
        for watcher in list(self._watchers.values()):
            watcher(name, fields)
        if changed:
            for callback in list(self._subscribers.values()):
                try:
                    callback(state)
                except Exception:  # a subscriber's fault must not stop the vehicle's state
                    logger.exception("%s: a subscriber of the state failed", self._url)

    def watch_clock(self, source: str, boot_ms: int, now_ns: int) -> None:
        """The autopilot's clock goes back: it has restarted, or another one speaks with its id by turns.

        Args:
            source: which message tells its time. Not all of one autopilot need go by the same clock.
            boot_ms: since it booted. now_ns: CLOCK_MONOTONIC.
        """
        if boot_ms < self._boot_ms.get(source, 0) - _BOOT_TOLERANCE_MS:
            again = bool(self._setbacks_ns) and now_ns - self._setbacks_ns[-1] < _TWO_CLOCKS_S * 1e9
            self._setbacks_ns.append(now_ns)
            first_ns = self._setbacks_ns[0]
            if len(self._setbacks_ns) == _SETBACKS_OF_TWO and now_ns - first_ns < _TWO_CLOCKS_S * 1e9:
                if not self.two_autopilots(now_ns):
                    self._on_two()
                self._two_heard_ns = now_ns
                self.restarted.clear()
            else:
                self._forget_what_held()
                if not again:  # nothing restarts twice so soon: perhaps these are two
                    self.restarted.set()
        self._boot_ms[source] = boot_ms

    def _watch_booting(self, booting: bool) -> None:
        """A heartbeat that says so for the first time is a restart, even where no message tells the time."""
        if booting and not self._booting and self.state.heartbeat_ns > 0:
            self._forget_what_held()
            self.restarted.set()
        self._booting = booting

    def _forget_what_held(self) -> None:
        """What held before a restart is not known to hold now, home least of all."""
        self._boot_ms.clear()
        self.clock.forget()
        self.state = replace(
            self.state,
            ready_to_arm=False,
            home_altitude_amsl_m=None,
            home_position_ned_m=None,
            position_valid=None,
            odometry=None,
            clock=None,
            gimbal=None,
        )

    def two_autopilots(self, now_ns: int) -> bool:
        """Two of the same id were heard a moment ago: their states cannot be told apart."""
        return self._two_heard_ns > 0 and now_ns - self._two_heard_ns < HEARTBEAT_MAX_AGE_S * 1e9

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        """Call back with every new snapshot; returns what ends that."""
        key = object()
        self._subscribers[key] = callback
        return lambda: self._subscribers.pop(key, None) and None

    def share_subscribers(self, other: TelemetryState) -> None:
        """Call back whoever has subscribed to another one, and whoever will."""
        self._subscribers = other._subscribers

    @contextlib.asynccontextmanager
    async def watching(self, watcher: Callable[[str, Fields], None]) -> AsyncIterator[None]:
        """Call back with every message for as long as this is entered."""
        key = object()
        self._watchers[key] = watcher
        try:
            yield
        finally:
            del self._watchers[key]

    async def until(self, met: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until a message makes the condition true; False when it did not in time."""
        done = asyncio.get_running_loop().create_future()

        def check(_name: str, _fields: Fields) -> None:
            if not done.done() and met():
                done.set_result(None)

        async with self.watching(check):
            check("", {})
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(timeout_s):
                    await done
        return met()
