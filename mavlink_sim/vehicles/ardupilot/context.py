"""What a Copter's services use of the vehicle they answer for."""

from __future__ import annotations

from typing import Protocol

from mavlink_sim.services.context import ServiceContext
from mavlink_sim.vehicles.ardupilot.autopilot import CopterAutopilot
from mavlink_sim.wire.links import Link


class CopterContext(ServiceContext, Protocol):
    """One Copter as its services see it; `copter.CopterVehicle` is one.

    Attributes:
        own_intervals: by link, the messages whose interval was set one by one.
        unsaved_rates: the values in storage of the rates that REQUEST_DATA_STREAM has set over them.
    """

    own_intervals: dict[str, set[str]]
    unsaved_rates: dict[str, float]

    @property
    def copter(self) -> CopterAutopilot: ...

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT on every link."""

    def send_text_once(self, severity: int, text: str) -> None: ...

    def send_home(self) -> None:
        """Send HOME_POSITION on every link."""

    def message_named(self, identifier: float) -> str | None:
        """The name of a message that can be sent, by its number."""

    def send_soon(self, link: Link, name: str) -> None:
        """Send it in the next step."""
