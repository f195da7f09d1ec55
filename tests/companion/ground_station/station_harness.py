"""A camera component without network, bus or clock, and the messages of a station."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.camera import Camera, VideoStream
from companion.ground_station.captures import Captures
from companion.ground_station.component import Message, is_addressed
from companion.ground_station.positions import Positions

SYSTEM, CAMERA_ID, STATION = 1, mavlink.MAV_COMP_ID_CAMERA, (255, 190)
S = 1_000_000_000
_ENCODER, _DECODER = mavlink.MAVLink(None), mavlink.MAVLink(None)


def jpeg(width: int = 64, height: int = 48) -> bytes:
    encoded, data = cv2.imencode(".jpg", np.zeros((height, width, 3), np.uint8))
    assert encoded
    return bytes(data.tobytes())


def received(message: Message, sender: tuple[int, int] = STATION) -> Message:
    """The message as another program receives it."""
    _ENCODER.srcSystem, _ENCODER.srcComponent = sender
    return _DECODER.decode(bytearray(message.pack(_ENCODER)))


def command_long(
    number: int,
    *parameters: float,
    target: tuple[int, int] = (SYSTEM, CAMERA_ID),
    confirmation: int = 0,
    sender: tuple[int, int] = STATION,
) -> Message:
    values = [*parameters, *[0.0] * (7 - len(parameters))]
    return received(mavlink.MAVLink_command_long_message(*target, number, confirmation, *values), sender)


def command_int(number: int, *parameters: float, target: tuple[int, int] = (SYSTEM, CAMERA_ID)) -> Message:
    first, x, y, z = [*parameters, *[0.0] * (4 - len(parameters))][:4], 0, 0, 0.0
    return received(mavlink.MAVLink_command_int_message(*target, 0, number, 0, 0, *first, x, y, z))


class CameraHarness:
    """A camera whose service runs. `warnings`: what it said. `now_ns` is moved by the test."""

    def __init__(self, directory: Path | None, *, streams: int = 1, status: bool = True) -> None:
        self.warnings: list[str] = []
        self.now_ns = 100 * S
        self.captures = Captures(directory, "camera", rate_hz=10.0, warn=self.warnings.append)
        self.positions = Positions()
        self.camera = Camera(
            None,
            CAMERA_ID,
            field_rad=1.0,
            captures=self.captures,
            positions=self.positions,
            warn=self.warnings.append,
        )
        self.camera.streams = [
            VideoStream(f"stream {number}", f"rtsp://127.0.0.1:8554/{number}") for number in range(streams)
        ]
        self.has_status = status
        self.due()

    def due(self) -> list[Message]:
        """What is sent by itself now."""
        if self.has_status:
            self.camera.on_status(self.now_ns)
        return [received(message, (SYSTEM, CAMERA_ID)) for message in self.camera.due(self.now_ns)]

    def ask(self, message: Message) -> list[Message]:
        """The answers to a message, as the link delivers it."""
        if not is_addressed(message, SYSTEM, CAMERA_ID):
            return []
        answers = self.camera.handle(message, self.now_ns)
        return [received(answer, (SYSTEM, CAMERA_ID)) for answer in answers]

    def sent_until(self, kind: str, tries: int = 400) -> list[Message]:
        """Everything that is sent until a message of a type is: files are written by a thread."""
        sent: list[Message] = []
        for _ in range(tries):
            sent += self.due()
            if kind in types(sent):
                return sent
            self.captures._executor.submit(lambda: None).result()
        raise AssertionError(f"no {kind} in {types(sent)}")


def types(messages: Iterable[Message]) -> list[str]:
    return [message.get_type() for message in messages]


def vehicle_body(stamp_ns: int, latitude_deg: float = 47.0, altitude_m: float = 10.0) -> Any:
    return {
        "stamp_ns": stamp_ns,
        "global_age_s": 0.0,
        "latitude_deg": latitude_deg,
        "longitude_deg": 8.0,
        "altitude_amsl_m": 500.0 + altitude_m,
        "altitude_m": altitude_m,
    }
