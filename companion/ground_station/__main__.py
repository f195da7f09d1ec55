"""The cameras of a vehicle for ground stations: `python -m companion.ground_station`, options as JSON."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.bus.bodies.service import EventBody, StatusBody
from companion.bus.bodies.vehicle import VehicleBody
from companion.bus.child_client import LISTENING, ChildClient, run_child
from companion.bus.topics import (
    CAMERA_INFO,
    COMMAND_STATE,
    DETECTIONS,
    EVENTS,
    STATUS,
    TRANSFORMS,
    VEHICLE,
)
from companion.ground_station import GroundStationError
from companion.ground_station.camera import COMPONENT_IDS, Camera
from companion.ground_station.captures import Captures
from companion.ground_station.component import Message
from companion.ground_station.feed import BusFeed
from companion.ground_station.link import StationLink
from companion.ground_station.objects import Objects
from companion.ground_station.parameters import Parameter, Parameters, definition
from companion.ground_station.positions import Positions
from companion.ground_station.reports import ComputerStatus, StatusTexts, reported_losses
from companion.ground_station.tracking import FLAGS, Tracking
from companion.ground_station.video import serve_video
from companion.settings.operator import GroundStationSection
from companion.vehicle.driver import LinkError
from companion.vehicle.link_url import parse_link_url
from companion.vehicle.signing import signer_of
from vision.home import expanded


def _work(client: ChildClient) -> None:
    asyncio.run(_run(client))


async def _run(client: ChildClient) -> None:
    options = client.options
    section = GroundStationSection.model_validate(options["settings"], strict=False)
    assert section.url is not None
    directory = None if options["directory"] is None else expanded(options["directory"])
    signing_key_file = options["signing_key_file"]
    texts = StatusTexts()

    def warn(text: str) -> None:
        texts.add(mavlink.MAV_SEVERITY_WARNING, text, time.monotonic_ns())
        client.say(text)

    cameras = _cameras(options, directory, warn)
    computer = ComputerStatus(Path.cwd() if directory is None else directory)
    cameras[0].sources += [texts.due, computer.due]
    feed = BusFeed(client, options["vehicle"])
    _subscribe(feed, cameras, texts)
    trackings = []
    for camera, about in zip(cameras, options["cameras"], strict=False):
        trackings.append(_track(feed, camera, about, texts, section))
        _offer_parameters(feed, camera, about, texts, section)

    def on_standstill() -> None:
        for tracking in trackings:
            tracking.abandon_clicks()

    link = StationLink(
        parse_link_url(section.url),
        options["system_id"],
        cameras,
        signer=None if signing_key_file is None else signer_of(signing_key_file),
        say=warn,
        on_standstill=on_standstill,
    )
    lost_here = {
        "messages of the bus left out: this computer is too slow, or they are of another version": lambda: (
            feed.dropped
        ),
        "warnings for stations left out: they were too many": lambda: texts.lost,
    }
    lost_of_stations = {
        "requests of stations left out: they were too many": lambda: link.dropped,
        "messages of stations refused: not signed, or not with the key of vehicle.signing_key_file": lambda: (
            link.refused
        ),
    }
    cameras[0].sources += [reported_losses(lost_here, client.say), reported_losses(lost_of_stations, warn)]
    open_parts: set[str] = set()

    def on_open(part: str) -> None:
        open_parts.add(part)
        if open_parts == {"link", "bus"}:
            ids = ", ".join(str(component.component_id) for component in link.components)
            client.say(f"{LISTENING}at {section.url}, camera {ids} of system {options['system_id']}")

    tasks = [
        asyncio.create_task(link.run(partial(on_open, "link"))),
        asyncio.create_task(asyncio.to_thread(feed.run, partial(on_open, "bus"))),
        asyncio.create_task(client.ended()),
    ]
    if section.video_listen is not None:
        images = options["image_width"], options["image_rate_hz"]
        tasks.append(asyncio.create_task(serve_video(section, cameras, feed, *images, warn)))
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        client.ending.set()
        feed.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for camera in cameras:
            await asyncio.to_thread(camera.captures.close)


def _cameras(options: dict[str, Any], directory: Path | None, warn: Callable[[str], None]) -> list[Camera]:
    cameras = []
    for component_id, about in zip(COMPONENT_IDS, options["cameras"], strict=False):
        name = about["name"]
        captures = Captures(directory, name or "camera", rate_hz=options["image_rate_hz"], warn=warn)
        cameras.append(
            Camera(
                name,
                component_id,
                field_rad=about["field_rad"],
                captures=captures,
                positions=Positions(),
                warn=warn,
            )
        )
    return cameras


def _subscribe(feed: BusFeed, cameras: list[Camera], texts: StatusTexts) -> None:
    def on_event(event: EventBody) -> None:
        texts.on_event(event["level"], event["text"], event["stamp_ns"], time.monotonic_ns())

    feed.subscribe(EVENTS, None, on_event)
    for camera in cameras:
        feed.subscribe(STATUS, None, partial(_on_status, camera))
        feed.subscribe(VEHICLE, None, camera.positions.on_vehicle)
        feed.subscribe(CAMERA_INFO, camera.name, camera.on_camera_info)
        feed.subscribe(TRANSFORMS, camera.name, camera.positions.on_transforms)
        camera.sources.append(_images_while_wanted(feed, camera))


def _on_status(camera: Camera, _status: StatusBody) -> None:
    camera.on_status(time.monotonic_ns())


def _track(
    feed: BusFeed, camera: Camera, about: dict[str, Any], texts: StatusTexts, section: GroundStationSection
) -> Tracking:
    """Add the tracking and the objects of a camera."""
    tracking = Tracking(
        about["word"],
        lambda: camera.component_id,
        camera.requests,
        max_age_s=about["max_age_s"],
        steers=about["steers"],
        follows=section.track_follows,
        send=feed.send_command,
        say=partial(_say, texts),
    )
    if about["tracks"]:  # `select` needs it
        camera.flags |= FLAGS
    camera.sources += [tracking.due, Objects(tracking, target_relative=section.target_relative).due]

    def on_status(status: StatusBody) -> None:
        tracking.on_service(status["service"])

    feed.subscribe(STATUS, None, on_status)
    feed.subscribe(VEHICLE, None, tracking.on_vehicle)
    feed.subscribe(DETECTIONS, camera.name, tracking.on_detections)
    feed.subscribe(COMMAND_STATE, None, tracking.on_command_state)
    return tracking


def _offer_parameters(
    feed: BusFeed, camera: Camera, about: dict[str, Any], texts: StatusTexts, section: GroundStationSection
) -> None:
    """Add the parameters of a camera, if it has any."""
    if not about["detects"] and camera.name is not None:
        return
    parameters = Parameters(
        camera.name,
        camera.requests,
        detects=about["detects"],
        query=feed.set_settings,
        say=partial(_say, texts),
    )
    camera.needs_definition = section.video_listen is not None
    described: tuple[Parameter, ...] = ()

    def due(now_ns: int) -> list[Message]:
        nonlocal described
        if parameters.are_complete and parameters.now != described:
            described = parameters.now
            camera.definition = definition(camera.label, described)
        return parameters.due(now_ns)

    def on_vehicle(vehicle: VehicleBody) -> None:
        parameters.on_vehicle(vehicle, time.monotonic_ns())

    camera.sources.append(due)
    feed.subscribe(STATUS, None, parameters.on_status)
    feed.subscribe(VEHICLE, None, on_vehicle)


def _say(texts: StatusTexts, severity: int, text: str) -> None:
    texts.add(severity, text, time.monotonic_ns())


def _images_while_wanted(feed: BusFeed, camera: Camera) -> Callable[[int], list[Message]]:
    """Return what subscribes to a camera's images while photos or a video are taken."""
    subscribed = False

    def on_image(jpeg: bytes, captured_ns: int) -> None:
        camera.captures.on_image(jpeg, captured_ns, time.monotonic_ns())

    def due(_now_ns: int) -> list[Message]:
        nonlocal subscribed
        if camera.captures.is_wanted != subscribed:
            subscribed = not subscribed
            feed.want_images(camera.name, "captures", on_image if subscribed else None)
        return []

    return due


if __name__ == "__main__":
    sys.exit(run_child(_work, refused=(GroundStationError, LinkError)))
