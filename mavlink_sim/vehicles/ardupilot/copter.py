"""A vehicle with the behaviour of an ArduPilot Copter."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

from mavlink_sim.vehicles.ardupilot import services, streams, telemetry
from mavlink_sim.vehicles.ardupilot.autopilot import CopterAutopilot
from mavlink_sim.vehicles.ardupilot.modes import CopterMode
from mavlink_sim.vehicles.ardupilot.parameters import CopterParameters
from mavlink_sim.vehicles.vehicle import Vehicle
from mavlink_sim.wire.announcements import Text
from mavlink_sim.wire.links import Link


class CopterVehicle(Vehicle):
    """See `Vehicle`, with Copter's parameters, without gimbal, obstacle sensor or a choice of PX4's release.

    Attributes:
        own_intervals: by link, the messages whose interval was set one by one.
        unsaved_rates: the values in storage of the rates that REQUEST_DATA_STREAM has set over them.

    Raises:
        ValueError: a gimbal, an obstacle sensor or a release of PX4 was requested.
    """

    autopilot_class = CopterAutopilot
    parameters_class = CopterParameters
    handlers: Mapping[str, Callable[[Any, Link, Any], None]] = services.HANDLERS

    def __init__(self, **options: Any) -> None:
        if options.get("gimbal"):
            raise ValueError("the ArduPilot vehicle has no gimbal: leave it out, or use PX4")
        if options.get("px4") is not None:
            raise ValueError(
                f"px4 {options['px4']!r}: the ArduPilot vehicle has no PX4 release; leave --px4 out"
            )
        if options.get("obstacle_sensor"):
            raise ValueError("the ArduPilot vehicle has no collision prevention: leave --obstacle-sensor out")
        self.own_intervals: dict[str, set[str]] = {}
        self.unsaved_rates: dict[str, float] = {}
        super().__init__(**options)

    modes = CopterMode
    stream_clock_rate = 1.0

    def mode_parameters(self, mode: CopterMode) -> tuple[float, float]:
        return mode.custom_mode, 0.0

    @property
    def setpoint_mode(self) -> str:
        return CopterMode.GUIDED.name

    def takeoff_plan(self, height_m: float) -> tuple[str | None, float, Callable[[], bool]]:
        """In GUIDED, to a height above home."""
        return "GUIDED", height_m, self._flies_guided

    def _flies_guided(self) -> bool:
        copter = self.copter
        return not copter.landed and copter.guided is not None and not copter.guided.is_taking_off

    @property
    def copter(self) -> CopterAutopilot:
        """The autopilot as its class."""
        return cast(CopterAutopilot, self.autopilot)

    def add_link(self, name: str, rates_hz: dict[str, float] | None = None) -> Link:
        """Attach a link. `rates_hz` is ignored: SR0_* and SR1_* set the rates."""
        link = super().add_link(name, streams.RATES_HZ)
        self.own_intervals[name] = set()
        streams.follow_parameters(self, link)
        return link

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT on every link."""
        self.autopilot.texts.append(Text(severity, text))

    def send_text_once(self, severity: int, text: str) -> None:
        if text not in self._sent_texts:
            self._sent_texts.add(text)
            self.send_text(severity, text)

    def send_home(self) -> None:
        """Send HOME_POSITION on every link, as when it changes."""
        for link in self.links.values():
            self.send_built(link, "HOME_POSITION")

    def message_named(self, identifier: float) -> str | None:
        """The name of a message that can be sent, by its number."""
        if not math.isfinite(identifier):
            return None
        return telemetry.MESSAGE_IDS.get(round(identifier))

    def send_built(self, link: Link, name: str) -> bool:
        builder = telemetry.BUILDERS.get(name)
        message = None if builder is None else builder(self)
        if message is not None:
            link.send(message)
        return message is not None

    def send_soon(self, link: Link, name: str) -> None:
        """Send it in the next step: after the acknowledgement that is sent now."""
        self.after(0.0, partial(self.send_built, link, name))

    def _boot(self) -> None:
        super()._boot()
        self._sent_texts: set[str] = set()
        self._sent_mode_changes = 0
        self._was_armed = False

    def reboot(self) -> None:
        """See Vehicle. Rates requested by messages are dropped."""
        super().reboot()
        streams.forget_requests(self)

    def _send_parameters(self) -> None:
        """Nothing is sent unrequested."""

    def _check_companion(self) -> None:
        """Copter has no check of the companion's heartbeat."""

    def _step(self, most: int) -> int:
        super()._step(1)  # one: mode and home are compared after each step
        copter = self.copter
        if copter.mode_changes != self._sent_mode_changes:
            self._sent_mode_changes = copter.mode_changes
            for link in self.links.values():
                self.send_built(link, "HEARTBEAT")
        if copter.armed and not self._was_armed:
            self.send_home()  # home is where it was armed
        self._was_armed = copter.armed
        return 1

    def _send_queued(self) -> None:
        """Send texts on every link with a client; no events, no gimbal commands."""
        while self.autopilot.texts:
            text = self.autopilot.texts.popleft()
            for link in self.links.values():
                if link.components:
                    link.ground_station_seen_s = self.now_s
                    link.send_text(text, self.now_s)
        self.autopilot.gimbal_commands.clear()
