"""What the MAVLink services use of the vehicle they answer for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from mavlink_sim.physics.vision_aiding import VisionAiding
from mavlink_sim.releases import Release
from mavlink_sim.services.event_protocol import EventContext
from mavlink_sim.services.file_transfer import FileContext
from mavlink_sim.services.gimbal_protocol import GimbalContext
from mavlink_sim.wire.links import Link


class CommandFilter(Protocol):
    """Faults that refuse commands before they are executed."""

    def refuses(self, command: int, parameters: tuple[float, ...]) -> int | None:
        """The MAV_RESULT of a rejected command; None: execute it."""


class ServiceContext(EventContext, FileContext, GimbalContext, Protocol):
    """One vehicle as its services see it.

    Attributes:
        links: by name. clock_ns: the boot clock of TIMESYNC. utc_ns: the time of SYSTEM_TIME.
        release: the PX4 release to be like. vision: what takes positions from a camera.
    """

    links: dict[str, Link]
    clock_ns: Callable[[], int]
    utc_ns: Callable[[], int]
    release: Release
    vision: VisionAiding

    @property
    def faults(self) -> CommandFilter: ...

    @property
    def boot_us(self) -> int: ...

    @property
    def home_altitude_m(self) -> float:
        """Of home above mean sea level."""

    def obstacle_below_m(self) -> float:
        """Along the body's down axis; inf: none."""

    def next_ping(self) -> int: ...

    def on_companion_heartbeat(self) -> None: ...

    def after(self, delay_s: float, action: Callable[[], object]) -> None:
        """Call `action` in a later step."""

    def send_built(self, link: Link, name: str) -> bool:
        """Send one telemetry message by name; False if it has nothing to report now."""


Handler = Callable[[ServiceContext, Link, Any], None]
Builder = Callable[[ServiceContext], Any]
