"""The vehicle of a conversation, through the asyncio client of its service."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeVar

import zenoh

from companion.bus import topics
from companion.bus.bodies.frames import DetectionBody, DetectionsBody, ObjectBody
from companion.bus.bodies.service import CommandStateBody, EventBody, StatusBody, StatusCameraBody
from companion.bus.bodies.vehicle import VehicleBody
from companion.bus.client import image_of
from companion.client import CommandFailedError, Drone, Stream
from companion.client.commands import Reply
from companion.host.peer_data import PeerDataError
from companion.language.control import CommandEvents, Control
from companion.language.conversation import Conversation, Operator
from companion.language.endpoints import Endpoint
from companion.language.scene import Scene, SceneObject
from companion.language.tools import class_names_of

T = TypeVar("T")

_DETECTOR_S = 15.0
_STATE_S = 4.0
# The kept events arrive within this.
_EVENTS_S = 0.3
# Events that may wait until they are read.
_WAITING_EVENTS = 1000
# An image and the detections of the same frame: so many frames may lie between their messages.
_FRAMES = 30


async def conversations(
    drone: Drone, endpoint: Endpoint | None, may: Collection[str]
) -> Callable[[Operator], Conversation]:
    """What makes conversations with the vehicle of a service. Waits until its detector has started.

    Raises:
        NoAnswerError: no service answers.
    """
    config = await drone.query("config")
    until_s = time.monotonic() + (_DETECTOR_S if config["detector"]["enabled"] else 0.0)
    # The classes are known when the detector has started.
    while (class_names := class_names_of(schema := await drone.query("commands"))) is None:
        if time.monotonic() >= until_s:
            break
        await asyncio.sleep(0.5)
    vehicle = LiveVehicle(drone, class_names or (), config["guidance"]["camera"])

    def converse(operator: Operator) -> Conversation:
        return Conversation(vehicle, operator, schema, class_names, endpoint=endpoint, may=may)

    return converse


class LiveVehicle:
    """One vehicle. `camera`: the steering one."""

    def __init__(self, drone: Drone, class_names: tuple[str, ...], camera: str | None) -> None:
        self._drone, self._class_names, self._camera = drone, class_names, camera
        self._commands, self._warnings = CommandEvents(), deque[str](maxlen=5)
        self._events: Stream[EventBody] | None = None
        self._missed = 0

    async def command(self, text: str) -> Reply:
        """Send a command and wait for its reply; a refused one is a reply too."""
        self._commands.send(text)
        try:
            return await self._drone.command(text)
        except CommandFailedError as error:
            return error.reply

    async def scene(self) -> Scene:
        """The objects of the newest frame with an image, and the vehicle's pose."""
        seen = await self._detections()
        fault = None if seen else await self._camera_fault()
        frame, colours = seen or (None, [])
        vehicle = await _next(self._drone.vehicle(), _STATE_S)
        yaw_rad = None if vehicle is None else vehicle["yaw_rad"]
        known = {} if frame is None else {each["object_id"]: each for each in frame["objects"]}
        objects = tuple(
            replace(_object(each, known.get(each["object_id"] or 0), vehicle), colour=colour)
            for each, colour in zip([] if frame is None else frame["detections"], colours, strict=True)
        )
        height_m = None if vehicle is None else vehicle["altitude_m"]
        return Scene(self._class_names, objects, yaw_rad, height_m, fault=fault)

    async def state(self) -> dict[str, Any]:
        """Facts in plain words and numbers; null where unknown."""
        await self._read_events()
        warnings = list(self._warnings)
        vehicle = await _next(self._drone.vehicle(), _STATE_S)
        status = await _next(self._drone.status(), _STATE_S)
        if vehicle is None or status is None:
            return {"error": "no state received from the service", "warnings": warnings}
        position, home, yaw_rad = vehicle["position_ned_m"], vehicle["home_ned_m"], vehicle["yaw_rad"]
        charge = vehicle["battery_fraction"]
        known = position is not None and home is not None
        return {
            "mode": vehicle["mode"],
            "armed": vehicle["armed"],
            "connected": vehicle["connected"],
            "height_above_home_m": _rounded(vehicle["altitude_m"]),
            "north_of_home_m": _rounded(position[0] - home[0]) if position and home and known else None,
            "east_of_home_m": _rounded(position[1] - home[1]) if position and home and known else None,
            "heading_deg": None if yaw_rad is None else round(math.degrees(yaw_rad)) % 360,
            "battery_percent": None if charge is None else round(100 * charge),
            "command": status["pilot"]["behaviour"],
            "in_command": status["pilot"]["in_command"],
            "camera": self._perception(status)["state"],
            "warnings": warnings,
        }

    async def control(self) -> Control:
        """Who controls the vehicle now."""
        await self._read_events()
        vehicle = await _next(self._drone.vehicle(), _STATE_S)
        if vehicle is None:
            return Control("no state received from the service", active=self._commands.active)
        mode = vehicle["mode"] if vehicle["armed"] else ""
        return Control(self._commands.lost, mode, self._commands.active)

    def ending(self, reply: Reply) -> CommandStateBody | None:
        """How the command of a reply has ended since; None: it has not."""
        return self._drone.ending(reply)

    async def forget_loss(self) -> None:
        """A loss of command until now does not count."""
        await self._read_events()
        self._commands.lost = None

    async def _read_events(self) -> None:
        """Read the events that have arrived, at first the kept ones."""
        if self._events is None:
            self._events = self._drone.events(size=_WAITING_EVENTS)
        with suppress(TimeoutError):
            async with asyncio.timeout(_EVENTS_S):
                async for event in self._events:
                    if self._events.dropped != self._missed:
                        self._missed = self._events.dropped
                        self._commands.lost = "events were missed"
                    self._commands.take(event["level"], event["text"])
                    if event["level"] != "info":
                        self._warnings.append(event["text"])

    def _perception(self, status: StatusBody) -> StatusCameraBody:
        return status["perception"] if self._camera is None else status["cameras"][self._camera]

    async def _camera_fault(self) -> str:
        """That no detections come, and what `status` says about it."""
        status = await _next(self._drone.status(), _STATE_S)
        if status is None:
            return "no detections received"
        camera = self._perception(status)
        facts = [f"perception is {camera['state']}"]
        if camera["state"] == "running" and camera["model"] is None:
            facts.append("no detector is enabled")
        if camera["problem"]:
            facts.append(camera["problem"])
        return f"no detections received: {'; '.join(facts)}"

    async def _detections(self) -> tuple[DetectionsBody, list[str | None]] | None:
        """A frame and the colours of its detections by its image; without an image, None for each.

        None: no frame came that a detector has seen.
        """
        frames = self._drone.detections(self._camera, size=_FRAMES)
        received: dict[int, DetectionsBody] = {}
        jpegs: dict[int, bytes] = {}
        newest: DetectionsBody | None = None
        subscriber = self._images(jpegs)
        try:
            async with asyncio.timeout(_STATE_S):
                async for frame in frames:
                    if frame["model"] is None:  # frames are read without a detector
                        return None
                    received[frame["sequence"]] = frame
                    newest = frame
                    if not frame["detections"]:
                        return frame, []
                    if common := received.keys() & jpegs.keys():
                        both = received[max(common)]
                        colours = await asyncio.to_thread(_colours, jpegs[max(common)], both)
                        return both, colours
        except TimeoutError:
            pass
        finally:
            frames.close()
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        return None if newest is None else (newest, [None] * len(newest["detections"]))

    def _images(self, jpegs: dict[int, bytes]) -> zenoh.Subscriber[None]:
        """Collect preview images by the number of their frame."""
        loop = asyncio.get_running_loop()

        def receive(sample: zenoh.Sample) -> None:
            # Another program's message has no such number; the loop may be closed.
            with suppress(PeerDataError, KeyError, RuntimeError):
                jpeg, about = image_of(sample)
                loop.call_soon_threadsafe(jpegs.__setitem__, about["sequence"], jpeg)

        key = topics.IMAGE.key(self._drone.name, self._camera)
        return self._drone.session.declare_subscriber(key, receive)


async def _next(stream: Stream[T], timeout_s: float) -> T | None:
    """The next message; None: there was none in time."""
    try:
        async with asyncio.timeout(timeout_s):
            return await anext(stream)
    except TimeoutError:
        return None
    finally:
        stream.close()


def _object(detection: DetectionBody, seen: ObjectBody | None, vehicle: VehicleBody | None) -> SceneObject:
    bearing_rad, range_m = detection["bearing_rad"], detection["ground_range_m"]
    yaw_rad, own = (None, None) if vehicle is None else (vehicle["yaw_rad"], vehicle["position_ned_m"])
    if seen is not None and (position := seen["position_ned_m"]) is not None and own is not None:
        north_m, east_m = position[0] - own[0], position[1] - own[1]
        bearing_rad, range_m = math.atan2(east_m, north_m), math.hypot(north_m, east_m)
    nose_deg = None
    if bearing_rad is not None and yaw_rad is not None:
        nose_deg = round(math.degrees(math.remainder(bearing_rad - yaw_rad, math.tau)), 1)
    return SceneObject(
        detection["class_name"],
        detection["track_id"],
        range_m=_rounded(range_m),
        bearing_deg=nose_deg,
    )


def _colours(jpeg: bytes, frame: DetectionsBody) -> list[str | None]:
    """The colour of each detection. The preview may be smaller than the frame."""
    from vision.colour import colour_of
    from vision.image_file import decode_image

    image = decode_image(jpeg)
    if image is None:
        return [None] * len(frame["detections"])
    scale = image.shape[1] / frame["width"]
    return [colour_of(image, [edge * scale for edge in each["xyxy"]]) for each in frame["detections"]]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 1)
