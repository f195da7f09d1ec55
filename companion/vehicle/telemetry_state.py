"""Maintains the vehicle state from the autopilot's messages, and notifies subscribers."""

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
from companion.vehicle.gimbal import Address
from companion.vehicle.gimbal_telemetry import ATTITUDE_STATUS, from_gimbal_device
from companion.vehicle.report import Report
from companion.vehicle.setpoint_echo import NAME as ECHO_NAME
from companion.vehicle.setpoint_echo import SetpointEcho
from companion.vehicle.state import HEARTBEAT_MAX_AGE_S, VehicleState
from companion.vehicle.telemetry import Fields, apply_message

logger = logging.getLogger(__name__)

REPORTS_KEPT = 20
_BOOT_TOLERANCE_MS = 1000  # datagrams may overtake each other
# A restart sets the clock back once; this many setbacks within this time are two alternating clocks.
_SETBACKS_OF_TWO = 3
_TWO_CLOCKS_S = 2.0
_BOOTING = 1  # MAV_STATE_BOOT
# Messages with the autopilot's clock; TIMESYNC and SYSTEM_TIME are checked by the driver.
_CLOCKED = ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ATTITUDE_QUATERNION")
_KINEMATIC = (*_CLOCKED, "ODOMETRY", "ESTIMATOR_STATUS", ATTITUDE_STATUS, ECHO_NAME)
# PX4 resends this message with the stamp of its first sending, which says nothing about the clock.
_OLD_STAMPED = "GIMBAL_MANAGER_INFORMATION"


class TelemetryState:
    """The state of one autopilot. Subscriptions persist when the link is reopened.

    Args:
        url: of the link, for the log. on_two_autopilots: called when two autopilots send with one id.
        own_address, range_finder_height: as in `VehicleState`.

    Attributes:
        state: the newest snapshot.
        profile: the profile of the connected autopilot.
        clock: synchronisation of its clock with ours.
        echo: compares the setpoints that it follows with ours.
        restarted: set when it has restarted; cleared by the link's supervision.
        restart_count: how often it has restarted.
        answered_ns: when the newest answered TIMESYNC request was sent, CLOCK_MONOTONIC.
    """

    def __init__(
        self,
        url: object,
        on_two_autopilots: Callable[[], None],
        range_finder_height: bool = False,
        own_address: Address = VehicleState.own_address,
    ) -> None:
        self._url, self._on_two_autopilots = url, on_two_autopilots
        self._own_address, self._range_finder_height = own_address, range_finder_height
        self._subscribers: dict[object, Callable[[VehicleState], None]] = {}
        self._watchers: dict[object, Callable[[str, Fields], None]] = {}
        self.reset()

    def reset(self) -> None:
        """Reset to the state before the first message."""
        self.state = VehicleState(
            range_finder_height=self._range_finder_height, own_address=self._own_address
        )
        self.profile: AutopilotProfile = Px4Profile()
        self.clock = ClockSync()
        self.echo = SetpointEcho()
        self.restart_count = self.answered_ns = 0
        self.restarted = asyncio.Event()
        self._boot_ms: dict[str, int] = {}
        self._booting = False
        self._setbacks_ns: deque[int] = deque(maxlen=_SETBACKS_OF_TWO)
        self._two_seen_ns = 0

    def handle(self, name: str, fields: Fields) -> None:
        """Translate and apply one message of the autopilot, and notify watchers."""
        for translated, translated_fields in self.profile.translate(name, fields, self.state):
            self.apply(translated, translated_fields)

    def handle_device(self, name: str, fields: Fields, component_id: int) -> None:
        """Apply a gimbal's attitude; ignore other messages of other components."""
        if from_gimbal_device(self.state, name, component_id):
            # The device has another clock: its message is stamped at its arrival.
            self.apply(name, {key: value for key, value in fields.items() if key != "time_boot_ms"})

    def apply(self, name: str, fields: Fields) -> None:
        """Apply one message in PX4's terms, and notify watchers."""
        now_ns = time.monotonic_ns()
        if name in _CLOCKED:
            self.watch_clock(name, fields["time_boot_ms"], now_ns)
        elif name == "HEARTBEAT":
            if not self.state.connected(now_ns):  # what answers after a silence may be another vehicle
                self.state = replace(self.state, vtol_state=None, is_plane=None)
            self._watch_booting(fields["system_status"] == _BOOTING)
        if name in _KINEMATIC and self.two_autopilots(now_ns):
            return  # Its sender is ambiguous: the state becomes stale, and what needs it ends.
        stamped = "time_boot_ms" in fields and name != _OLD_STAMPED
        stamp_ns = self.clock.stamp(fields["time_boot_ms"], now_ns) if stamped else now_ns
        if name == ECHO_NAME:
            self.echo.received(fields, self.state, now_ns, self.answered_ns)
            return
        state = apply_message(self.state, name, fields, stamp_ns)
        if name in ("HEARTBEAT", "CURRENT_MODE"):
            state = self.echo.confirm(state, now_ns)
        if (
            state.reset_count != self.state.reset_count
            or state.position_valid is not self.state.position_valid
        ):
            self._log_estimate(state)
        self._publish(state, name, fields)

    def _log_estimate(self, state: VehicleState) -> None:
        """Log a reset of the estimate, or a change of its validity."""
        if state.reset_count != self.state.reset_count:
            logger.warning("%s: position estimate %s", self._url, state.reset_words(self.state))
        elif state.position_valid is False:
            logger.warning("%s: position estimate not valid", self._url)
        elif self.state.position_valid is False:
            logger.info("%s: position estimate valid again", self._url)

    def on_report(self, report: Report | None) -> None:
        """Add a text report; None is ignored."""
        if report is not None:
            reports = (*self.state.reports, report)[-REPORTS_KEPT:]
            self._publish(replace(self.state, reports=reports), "REPORT", {"report": report})

    def on_mode_restored(self, text: str) -> None:
        """Note that a pilot's mode was requested again."""
        self._publish(replace(self.state, mode_restored=text), "MODE_RESTORED", {})

    def on_commander(self, commander: Commander) -> None:
        """Note a heartbeat of another service on the same vehicle."""
        others = (other for other in self.state.other_commanders if other.address != commander.address)
        self._publish(replace(self.state, other_commanders=(*others, commander)), "COMMANDER", {})

    def on_shared_address(self, now_ns: int, *, commands: bool) -> None:
        """Note that another program uses our address; `commands`: it has moved the vehicle."""
        state = replace(self.state, address_shared_ns=now_ns)
        if commands:
            state = replace(state, foreign_command_ns=now_ns)
        self._publish(state, "COMMANDER", {})

    def use_address(self, own_address: Address) -> None:
        """From now on our messages have this address."""
        self._own_address = own_address
        self._publish(replace(self.state, own_address=own_address, address_shared_ns=0), "COMMANDER", {})

    def use_program(self, *, is_plane: bool) -> None:
        """From now on this ArduPilot is Plane, or Copter (`vehicle_type`)."""
        self._publish(replace(self.state, is_plane=is_plane), "PROGRAM", {})

    def _publish(self, state: VehicleState, name: str, fields: Fields) -> None:
        """Set the state after a message, and notify watchers and subscribers."""
        changed, self.state = state is not self.state, state
        for watcher in list(self._watchers.values()):
            watcher(name, fields)
        if changed:
            for callback in list(self._subscribers.values()):
                try:
                    callback(state)
                except Exception:  # a subscriber's error must not stop the state updates
                    logger.exception("%s: a subscriber of the state failed", self._url)

    def watch_clock(self, source: str, boot_ms: int, now_ns: int) -> None:
        """Detect a restart, or a second autopilot with the same id, by a clock that goes back.

        Args:
            source: the message with the time. An autopilot may use several clocks.
            boot_ms: since it booted. now_ns: CLOCK_MONOTONIC.
        """
        if boot_ms < self._boot_ms.get(source, 0) - _BOOT_TOLERANCE_MS:
            again = bool(self._setbacks_ns) and now_ns - self._setbacks_ns[-1] < _TWO_CLOCKS_S * 1e9
            self._setbacks_ns.append(now_ns)
            first_ns = self._setbacks_ns[0]
            if len(self._setbacks_ns) == _SETBACKS_OF_TWO and now_ns - first_ns < _TWO_CLOCKS_S * 1e9:
                if not self.two_autopilots(now_ns):
                    self._on_two_autopilots()
                self._two_seen_ns = now_ns
                self.restarted.clear()
            else:
                self._invalidate()
                if not again:  # a second restart so soon may be a second autopilot instead
                    self.restarted.set()
        self._boot_ms[source] = boot_ms

    def _watch_booting(self, booting: bool) -> None:
        """Detect a restart by the first heartbeat in MAV_STATE_BOOT, also without a clock."""
        if booting and not self._booting and self.state.heartbeat_ns > 0:
            self._invalidate()
            self.restarted.set()
        self._booting = booting

    def _invalidate(self) -> None:
        """Clear what a restart may have changed, such as home."""
        self.restart_count += 1
        self._boot_ms.clear()
        self.clock.reset()
        self.state = replace(
            self.state,
            ready_to_arm=False,
            home_altitude_amsl_m=None,
            home_position_ned_m=None,
            position_valid=None,
            vtol_state=None,
            is_plane=None,
            ground=None,
            odometry=None,
            clock=None,
            gimbal=None,
        )

    def discard_received(self) -> None:
        """The computer stood still: what is known of the vehicle is outdated."""
        self.clock.reset()
        self._publish(
            replace(
                self.state,
                heartbeat_ns=0,
                attitude_ns=0,
                position_ns=0,
                global_ns=0,
                battery_ns=0,
                attitude=None,
                position_ned_m=None,
                vtol_state=None,
                is_plane=None,
                ground=None,
                odometry=None,
                clock=None,
                gimbal=None,
            ),
            "DISCARDED",
            {},
        )

    def two_autopilots(self, now_ns: int) -> bool:
        """Whether two autopilots with one id were detected recently."""
        return self._two_seen_ns > 0 and now_ns - self._two_seen_ns < HEARTBEAT_MAX_AGE_S * 1e9

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        """Call back with every new snapshot; returns a function that unsubscribes."""
        key = object()
        self._subscribers[key] = callback
        return lambda: self._subscribers.pop(key, None) and None

    @contextlib.asynccontextmanager
    async def watching(self, watcher: Callable[[str, Fields], None]) -> AsyncIterator[None]:
        """Call back with every message while the context is active."""
        end = self.watch(watcher)
        try:
            yield
        finally:
            end()

    def watch(self, watcher: Callable[[str, Fields], None]) -> Callable[[], None]:
        """Call back with every message, in order of registration; returns a function that ends it."""
        key = object()
        self._watchers[key] = watcher
        return lambda: self._watchers.pop(key, None) and None

    async def until(self, met: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until a message makes the condition true; False on timeout."""
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
