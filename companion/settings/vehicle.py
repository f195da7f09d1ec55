"""The settings of the link to the autopilot."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.settings.section import Section
from companion.settings.texts import KeyWord, VehicleUrl

NO_VEHICLE = "none"
# Ours is the first that no other program has: MAV_COMP_ID_ONBOARD_COMPUTER to …COMPUTER4.
COMPONENT_IDS = (191, 192, 193, 194)


class VehicleSection(Section):
    """The autopilot, and the vehicle's name."""

    url: VehicleUrl = "udpin://127.0.0.1:14540"
    """udpin:// (listen), udpout:// or tcp://HOST:PORT, serial:///dev/ttyAMA0:921600; none: no vehicle"""
    driver: Literal["pymavlink", "mavsdk", "auto"] = "pymavlink"
    """MAVLink library; pymavlink (also auto) flies PX4 and ArduPilot, mavsdk (extra `service`) PX4 only"""
    system_id: Annotated[int, Field(ge=1, le=255)] = 1
    """the autopilot's MAVLink system id"""
    name: KeyWord = "vehicle1"
    """the vehicle's name in zenoh keys: companion/NAME/detections"""
    connect_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    """how long play, demo and detect wait for the first heartbeat, seconds; run waits without limit"""
    allow_other_commander: bool = False
    """fly even if another service commands the same vehicle; by default the later one refuses"""
    signing_key_file: str | None = None
    """MAVLink signing key file: 32 bytes or a passphrase, readable by its owner only; unset: no signing"""

    @property
    def expected(self) -> bool:
        """Whether there is to be an autopilot."""
        return self.url != NO_VEHICLE
