"""Periodic work of the guidance loop: link state, heartbeat, systemd's watchdog, video overlay."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from companion.guidance.authority import DEFAULT_ACCEPTANCE_M
from companion.guidance.core import Guidance
from companion.perception.cameras import WorkerCamera
from companion.service.inputs import InputAssembler
from companion.service.other_commanders import OtherCommanders
from companion.service.systemd_notify import SystemdNotifier
from companion.vehicle.driver import CommandRefusedError, Driver, SystemStatus
from companion.vehicle.state import VehicleState
from companion.vehicle.vehicle_type import VTOL_STATE_MISSING

HEARTBEAT_PERIOD_S = 1.0
HUD_PERIOD_S = 0.2
# ArduPilot's default, for which it continues a velocity; 1 s is advised (docs/safety.md).
LONG_GUIDED_TIMEOUT_S = 3.0


class Health:
    """Called by the guidance loop: when that hangs, the heartbeat and the watchdog stop too.

    Args:
        inputs: gets what `check` reads for guidance.
        others: other services that command the vehicle; checked from here.
        on_event: called with (level, text) for the operator.
    """

    def __init__(
        self,
        driver: Driver,
        inputs: InputAssembler,
        cameras: Sequence[WorkerCamera],
        notifier: SystemdNotifier,
        others: OtherCommanders,
        on_event: Callable[[str, str], None],
    ) -> None:
        self._driver, self._inputs, self._cameras, self._notifier = driver, inputs, cameras, notifier
        self._others, self._on_event = others, on_event
        self._heartbeat_due_ns = self._hud_due_ns = 0
        self._linked = False
        self._not_flown: str | None = None
        self._link_count = 0
        self._check_due = asyncio.Event()

    def healthy(self, now_ns: int) -> bool:
        """Whether every camera delivers results and the autopilot is connected."""
        return all(camera.seeing(now_ns) for camera in self._cameras) and self._driver.state.connected(now_ns)

    async def run(self) -> None:
        """Run `check` whenever the link has opened or returned, or the autopilot has restarted."""
        while True:
            await self._check_due.wait()
            self._check_due.clear()
            await self.check()

    async def check(self) -> None:
        """Read the autopilot's parameters that matter here."""
        autopilot = self._driver.state.autopilot
        if autopilot == "PX4":
            assumed = f"{DEFAULT_ACCEPTANCE_M:g} m assumed"
            self._inputs.altitude_acceptance_m = await self._parameter("NAV_MC_ALT_RAD", assumed)
        timeout_s = None
        if autopilot == "ArduPilot":
            timeout_s = await self._parameter("GUID_TIMEOUT", "check that it is 1")
        if timeout_s is not None and timeout_s >= LONG_GUIDED_TIMEOUT_S:
            self._on_event(
                "warning",
                f"GUID_TIMEOUT is {timeout_s:g} s: ArduPilot flies on for that long on silence; set it to 1",
            )

    async def _parameter(self, name: str, otherwise: str) -> float | None:
        """Return a parameter; None: it cannot be read, which is reported with what follows."""
        try:
            return await self._driver.get_parameter(name)
        except CommandRefusedError as error:
            self._on_event("warning", f"{error}: {otherwise}")
            return None

    def after_step(self, now_ns: int, guidance: Guidance) -> None:
        """Run the periodic work; call after every step of guidance."""
        if self._driver.link_count != self._link_count:
            self._link_count = self._driver.link_count
            self._inputs.altitude_acceptance_m = None  # it may have been changed meanwhile
            self._check_due.set()
        linked = self._driver.state.connected(now_ns)
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
            healthy = self.healthy(now_ns)
            self._driver.send_heartbeat(
                SystemStatus.ACTIVE if healthy else SystemStatus.CRITICAL,
                uptime_s=self._others.uptime_s(now_ns),
                in_command=guidance.in_command,
            )
            self._others.watch(self._driver.state, now_ns)
            self._notifier.alive()
        if now_ns >= self._hud_due_ns:
            self._hud_due_ns = now_ns + round(HUD_PERIOD_S * 1e9)
            lines = hud_lines(self._driver.state, guidance.status)
            for camera in self._cameras:
                camera.supervisor.send_hud(lines)

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
