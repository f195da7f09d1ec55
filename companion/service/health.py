"""Periodic work of the guidance loop: link state, heartbeat, systemd's watchdog, video overlay."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import TypeVar

from companion.guidance.core import Guidance
from companion.host.tasks import keep_running
from companion.perception.cameras import WorkerCamera
from companion.service.inputs import InputAssembler
from companion.service.other_commanders import OtherCommanders
from companion.service.systemd_notify import SystemdNotifier
from companion.vehicle.autopilot_parameters import NOTHING_READ, AutopilotParameters, parameter_names
from companion.vehicle.driver import CommandRefusedError, Driver, SystemStatus
from companion.vehicle.setpoint_loss import SetpointLossOutcome, setpoint_loss_outcome
from companion.vehicle.state import VehicleState
from companion.vehicle.vehicle_type import VTOL_STATE_MISSING

HEARTBEAT_PERIOD_S = 1.0
HUD_PERIOD_S = 0.2

Read = TypeVar("Read")


class Health:
    """Called by the guidance loop: when that hangs, the heartbeat and the watchdog stop too.

    Args:
        inputs: gets what `check` reads for guidance.
        others: other services that command the vehicle; checked from here.
        on_event: called with (level, text) for the operator.
        has_vehicle: an autopilot is expected.
    """

    def __init__(
        self,
        driver: Driver,
        inputs: InputAssembler,
        cameras: Sequence[WorkerCamera],
        notifier: SystemdNotifier,
        others: OtherCommanders,
        on_event: Callable[[str, str], None],
        *,
        has_vehicle: bool = True,
    ) -> None:
        self._has_vehicle = has_vehicle
        self._driver, self._inputs, self._cameras, self._notifier = driver, inputs, cameras, notifier
        self._others, self._on_event = others, on_event
        self._heartbeat_due_ns = self._hud_due_ns = 0
        self._linked = False
        self._not_flown: str | None = None
        self._link_count = 0
        self._check_due = asyncio.Event()
        self._setpoint_loss_of: tuple[AutopilotParameters, bool] | None = None

    @property
    def setpoint_loss(self) -> SetpointLossOutcome:
        """What the autopilot does without setpoints."""
        return setpoint_loss_outcome(
            self._inputs.parameters, sticks_present=self._driver.state.sticks_present
        )

    def unhealthy(self, now_ns: int) -> list[str]:
        """Which camera delivers no results (or frames), and a missing autopilot, with reasons."""
        state, reasons = self._driver.state, list[str]()
        if self._has_vehicle and not state.connected(now_ns):
            silent = f"for {(now_ns - state.heartbeat_ns) / 1e9:.0f} s" if state.heartbeat_ns else "yet"
            reasons.append(f"autopilot: no heartbeat {silent}")
        for camera in self._cameras:
            if why := camera.blind(now_ns):
                reasons.append(f"{'camera' if camera.name is None else f'camera {camera.name}'}: {why}")
        return reasons

    async def run(self) -> None:
        """Run `check` whenever the link has opened or returned, or the autopilot has restarted."""
        await keep_running("health", self._check_when_due, self._on_event)

    async def _check_when_due(self) -> None:
        self._check_due.set()  # also after a fault in the last one
        while True:
            await self._check_due.wait()
            self._check_due.clear()
            await self.check()

    async def check(self) -> None:
        """Read the autopilot's version and the parameters that matter here, and report what follows."""
        autopilot, link_count = self._driver.state.autopilot, self._driver.link_count
        if autopilot is None:
            return
        version = await self._read(self._driver.firmware_version())
        names = parameter_names(autopilot, version)
        values = await asyncio.gather(*(self._read(self._driver.get_parameter(name)) for name in names))
        known = tuple((name, value) for name, value in zip(names, values, strict=True) if value is not None)
        if self._driver.link_count != link_count:
            return  # the next check reads again
        system_id = self._driver.own_address[0]
        read = self._inputs.parameters = AutopilotParameters(autopilot, version, system_id, known)
        if (sticks := read.sticks_text) is not None:
            self._on_event("info", sticks)

    async def _read(self, reading: Awaitable[Read]) -> Read | None:
        """Return what was read; None: it cannot be read, which is reported."""
        try:
            return await reading
        except CommandRefusedError as error:
            self._on_event("warning", f"{error}: not assumed; what depends on it is reported as not known")
            return None

    def _report_setpoint_loss(self) -> None:
        """Report what the autopilot does without setpoints, again whenever it changes."""
        read, state = self._inputs.parameters, self._driver.state
        sticks = state.sticks_present
        if read.autopilot is None or state.not_flown is not None or (read, sticks) == self._setpoint_loss_of:
            return
        self._setpoint_loss_of = (read, sticks)
        outcome = self.setpoint_loss
        self._on_event("warning" if outcome.warning else "info", outcome.text)

    def after_step(self, now_ns: int, guidance: Guidance) -> None:
        """Run the periodic work; call after every step of guidance."""
        if self._driver.link_count != self._link_count:
            self._link_count = self._driver.link_count
            self._inputs.parameters = NOTHING_READ  # they may have been changed meanwhile
            self._setpoint_loss_of = None
            self._check_due.set()
        self._report_setpoint_loss()
        # Until the driver has connected, the heartbeat may be that of an autopilot that it does not support.
        found = self._driver.link_count > 0
        linked = found and self._driver.state.connected(now_ns)
        if linked != self._linked:
            self._linked = linked
            if linked:
                autopilot, library = self._driver.state.autopilot, self._driver.library
                self._on_event("info", f"autopilot heartbeat received: {autopilot}, {library} driver")
            else:
                self._on_event("error", "autopilot heartbeat lost")
        self._report_not_flown(self._driver.state)
        if now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = now_ns + round(HEARTBEAT_PERIOD_S * 1e9)
            if found:  # before, the driver still chooses its address
                self._send_heartbeat(now_ns, guidance)
            self._others.watch(
                self._driver.state,
                now_ns,
                self.setpoint_loss,
                in_command=guidance.in_command,
                exact_echo=self._inputs.parameters.exact_echo,
            )
            self._notifier.alive()
        if now_ns >= self._hud_due_ns:
            self._hud_due_ns = now_ns + round(HUD_PERIOD_S * 1e9)
            lines = hud_lines(self._driver.state, guidance.status)
            for camera in self._cameras:
                camera.supervisor.send_hud(lines)

    def _send_heartbeat(self, now_ns: int, guidance: Guidance) -> None:
        shared = self._others.shares_address(self._driver.state, now_ns)
        if shared and not guidance.in_command:
            self._driver.change_address()
        self._driver.send_heartbeat(
            SystemStatus.CRITICAL if self.unhealthy(now_ns) else SystemStatus.ACTIVE,
            uptime_s=self._others.uptime_s(now_ns),
            in_command=guidance.in_command,
        )

    def _report_not_flown(self, state: VehicleState) -> None:
        """Report a vehicle that gets no flight commands, and when it gets them again."""
        why = state.not_flown
        if why == self._not_flown or why == VTOL_STATE_MISSING:  # which is no answer yet
            return
        self._not_flown = why
        if why is not None:
            self._on_event("error", f"no flight commands: {why}")
        else:
            self._on_event("info", "flight commands are accepted: the vehicle is flown")


def hud_lines(state: VehicleState, status: str) -> tuple[str, ...]:
    """Return the overlay lines of the recorded video. `status`: guidance's, as text."""
    altitude = "-" if state.altitude_m is None else f"{state.altitude_m:.1f} m"
    speed = state.velocity_ned_mps
    horizontal = "-" if speed is None else f"{(speed[0] ** 2 + speed[1] ** 2) ** 0.5:.1f} m/s"
    return (
        f"{state.mode.value}  {'armed' if state.armed else 'disarmed'}",
        status,
        f"height {altitude}  speed {horizontal}",
    )
