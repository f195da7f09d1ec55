"""Creates the parts of a service from its settings; flights in lockstep use the same functions."""

from __future__ import annotations

import json
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import Any, NamedTuple

from companion.bus.child_client import LISTENING, PAUSED
from companion.bus.client import NoAnswerError, settings_for_child
from companion.bus.config import BusError
from companion.bus.topics import IMAGE
from companion.guidance.behaviours.select import FIRST_CAMERA
from companion.guidance.core import GuidanceOptions
from companion.guidance.gimbal.controller import GimbalMounting
from companion.guidance.limits.battery import BatteryMinimum
from companion.guidance.limits.envelope import Limits
from companion.guidance.limits.obstacles import ObstacleRules
from companion.host.child_process import child_process
from companion.perception.cameras import recorded_frames_names
from companion.recording import RECORDED, RECORDING
from companion.settings import CameraSection, Settings
from companion.settings.vehicle import COMPONENT_IDS
from companion.vehicle.driver import Driver, OnBytes
from companion.vehicle.drivers import open_driver
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.signing import signer_of
from companion.vehicle.streamer import Streamer

# Beginnings of the lines that its clients print when all is well.
_ROUTINE = (RECORDING, RECORDED, LISTENING)


class _Client(NamedTuple):
    """A client of the bus that the service starts: `python -m MODULE`, with options.

    Attributes:
        end_s: it is killed if it takes longer to end, seconds.
    """

    module: str
    options: dict[str, Any]
    end_s: float = 5.0


def driver_of(settings: Settings, on_bytes: OnBytes | None = None) -> Driver:
    """Create the driver, not connected yet. `on_bytes`: called with everything on the link."""
    return open_driver(
        settings.vehicle.driver,
        settings.vehicle.url,
        system_id=settings.vehicle.system_id,
        own_system_id=settings.vehicle.system_id,
        own_component_id=COMPONENT_IDS[0],
        other_component_ids=COMPONENT_IDS[1:],
        signer=None
        if settings.vehicle.signing_key_file is None
        else signer_of(settings.vehicle.signing_key_file),
        range_finder_height=settings.guidance.range_finder_height,
        on_bytes=on_bytes,
    )


def guidance_options(settings: Settings) -> GuidanceOptions:
    """Create guidance's options."""
    guidance = settings.guidance
    cameras = [settings.of_camera(name).camera for name in (None, *settings.cameras)]
    return GuidanceOptions(
        limits=limits_of(settings),
        lifetime_s=guidance.setpoint_lifetime_s,
        battery=BatteryMinimum(guidance.min_battery_percent / 100.0, guidance.low_battery),
        obstacles=ObstacleRules(
            guidance.obstacles,
            guidance.obstacle_margin_m,
            guidance.max_speed_unobserved_mps,
            guidance.perception_max_age_s,
        ),
        avoid=guidance.avoid,
        send_obstacle_distance=guidance.send_obstacle_distance,
        perception_max_age_s=guidance.perception_max_age_s,
        track_max_age_s=settings.of_camera(guidance.camera).tracker.max_age_s,
        gimbal=gimbal_mounting(cameras, settings.of_camera(guidance.camera).camera),
    )


def gimbal_mounting(cameras: Sequence[CameraSection], steering: CameraSection) -> GimbalMounting:
    """Return which cameras the gimbal carries: any of all cameras, and the steering one."""
    return GimbalMounting(
        carries_camera=any(camera.on_gimbal for camera in cameras),
        carries_steering=steering.on_gimbal,
        camera_pitch_rad=steering.mount().pitch_rad,
    )


def streamer_of(
    settings: Settings, send: Callable[[Setpoint], None], clock_ns: Callable[[], int] = time.monotonic_ns
) -> Streamer:
    """Create the streamer. `send` sends a setpoint to the autopilot."""
    guidance = settings.guidance
    return Streamer(send, rate_hz=guidance.setpoint_rate_hz, brake_s=guidance.brake_s, clock_ns=clock_ns)


def limits_of(settings: Settings) -> Limits:
    """Return the envelope's limits, from the settings of the same names."""
    guidance = settings.guidance
    return Limits(
        max_horizontal_speed_mps=guidance.max_horizontal_speed_mps,
        max_climb_mps=guidance.max_climb_mps,
        max_descend_mps=guidance.max_descend_mps,
        max_yaw_rate_radps=guidance.max_yaw_rate_radps,
        max_acceleration_mps2=guidance.max_acceleration_mps2,
        min_altitude_m=guidance.min_altitude_m,
        max_altitude_m=guidance.max_altitude_m,
        max_distance_m=guidance.max_distance_m,
        fence=guidance.fence(),
        min_separation_m=guidance.min_separation_m,
    )


def _clients(settings: Settings) -> Iterator[tuple[str, _Client]]:
    """Yield the clients that are set, by their names."""
    if settings.recording.directory:
        recording = settings.recording
        options = recording.model_dump(include={"directory", "max_file_mb", "max_total_mb"})
        options |= {"images": recording.images}
        options |= {kind: kind in recording.content for kind in ("depth", "clouds")}
        options["frames"] = {
            IMAGE.path(camera): name for camera, name in recorded_frames_names(settings).items()
        }
        # With low priority on a busy computer it takes seconds to finish its file.
        yield "recorder", _Client("companion.recording", options, end_s=20.0)
    if settings.foxglove.listen is not None:
        yield "foxglove", _Client("companion.recording", settings.foxglove.model_dump())
    if settings.ros2.rmw_zenoh or settings.ros2.plain_keys:
        yield "ros2", _Client("companion.ros2", {"settings": settings.ros2.model_dump(mode="json")})
    if settings.mqtt.url is not None or settings.mqtt.webhooks:
        options = {"mqtt": settings.mqtt.model_dump(mode="json"), "cameras": list(settings.cameras)}
        yield "mqtt", _Client("companion.mqtt", options)
    if settings.ground_station.url is not None:
        yield "ground_station", _Client("companion.ground_station", _ground_station_options(settings))


def _ground_station_options(settings: Settings) -> dict[str, Any]:
    cameras = {name: settings.of_camera(name) for name in (None, *settings.cameras)}
    return {
        "settings": settings.ground_station.model_dump(mode="json"),
        "system_id": settings.vehicle.system_id,
        "signing_key_file": settings.vehicle.signing_key_file,
        "directory": settings.recording.directory or None,
        "image_rate_hz": settings.preview.rate_hz,
        "image_width": settings.preview.width,
        "cameras": [
            {
                "name": name,
                "field_rad": camera.camera.field_rad,
                "word": name or FIRST_CAMERA,
                "steers": name == settings.guidance.camera,
                "max_age_s": camera.tracker.max_age_s,
                "detects": camera.detector.enabled,
                "tracks": camera.detector.enabled and camera.tracker.enabled,
            }
            for name, camera in cameras.items()
        ],
    }


@asynccontextmanager
async def clients_of(
    settings: Settings, on_event: Callable[[str, str], None], on_state: Callable[[str, str, bool], None]
) -> AsyncIterator[None]:
    """Run meanwhile the clients that are set: recorder, Foxglove live, ROS 2 over zenoh, ground station.

    Args:
        on_event: called with (level, text).
        on_state: called with a client's name, why it does not work (empty: it does), and whether it is
            tried again.
    """

    def say(line: str) -> None:
        name, _, text = line.partition(": ")
        well = text.startswith(_ROUTINE)
        on_event("info" if well else "warning", line)
        if well or text.startswith(PAUSED):  # any other line, such as a library's, is no state
            on_state(name, "" if well else text, True)

    async with AsyncExitStack() as stack:
        for name, client in _clients(settings):
            on_state(name, "it is starting", True)
            try:
                zenoh = settings_for_child(settings.zenoh)
            except (NoAnswerError, BusError) as error:
                say(f"{name}: {error}")
                on_state(name, str(error), False)
                continue
            argument = json.dumps({"zenoh": zenoh, "vehicle": settings.vehicle.name, **client.options})
            program = child_process(
                name,
                client.module,
                argument,
                say,
                on_end=partial(on_state, name),
                end_s=client.end_s,
            )
            await stack.enter_async_context(program)
        yield
