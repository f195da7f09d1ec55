"""The settings of the link to the autopilot."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.settings.section import Section
from companion.settings.texts import KeyWord, VehicleUrl


class VehicleSection(Section):
    """The autopilot, and what the vehicle is called."""

    url: VehicleUrl = "udpin://127.0.0.1:14540"
    """where the autopilot is: udpin:// (listen), udpout:// or tcp://HOST:PORT, or serial:///dev/ttyAMA0:921600"""
    driver: Literal["auto", "mavsdk", "pymavlink"] = "auto"
    """the library that speaks MAVLink; auto takes mavsdk for PX4, pymavlink for ArduPilot"""
    system_id: Annotated[int, Field(ge=1, le=255)] = 1
    """the autopilot's MAVLink system id"""
    name: KeyWord = "vehicle1"
    """what the vehicle is called in zenoh's keys: companion/NAME/detections"""
    connect_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    """how long to wait for the autopilot's first heartbeat, seconds"""
    allow_other_commander: bool = False
    """fly although another service commands the same vehicle; by default the later one refuses"""
    signing_key_file: str | None = None
    """sign MAVLink with this file's 32 bytes or passphrase, readable by its owner alone; unset: unsigned"""
