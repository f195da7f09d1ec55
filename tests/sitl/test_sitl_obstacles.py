"""A pilot before a wall that only the companion's camera sees, on the PX4 at COMPANION_SITL_URL."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.camera.simulated_camera import SimulatedCamera
from mavlink_sim.wire.messages import dialect
from mavlink_sim.world.world import Ground, World, WorldObject
from tests.companion.service_process import running_service
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import (
    PX4,
    READY_S,
    STANDING_MPS,
    AutopilotLink,
    Flight,
    bring_down,
    repeated,
    set_for_test,
)
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_euler
from vision.shared_frame import SharedFrameWriter

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
POSITION_MODE = 3 << 16
CAMERA, MOUNT = CameraModel.from_horizontal_fov(160, 120, math.radians(80.0)), CameraMount()
WALL_M, THICKNESS_M, KEEP_M = 14.0, 0.4, 3.0
FULL, NEUTRAL = 1000, 0


def wall_ahead(link: AutopilotLink) -> WorldObject:
    """A wall across the way of the nose, from the ground up."""
    pose = link.poses[-1]
    north, east, _ = pose.position_ned_m
    ahead = WALL_M + THICKNESS_M / 2
    place = (north + ahead * math.cos(pose.yaw_rad), east + ahead * math.sin(pose.yaw_rad), 0.0)
    return WorldObject(0, "wall", place, pose.yaw_rad, size_m=(30.0, THICKNESS_M, 9.0))


def frames(link: AutopilotLink, wall: WorldObject, writer: SharedFrameWriter) -> Iterator[None]:
    """Draw what the camera sees from the autopilot's own pose, and share it."""
    ground = Ground(("gravel",), 5, 256, 0.05)
    sensed = CameraSettings(model=CAMERA, mount=MOUNT, effects=None, depth=DepthSensor())
    camera = SimulatedCamera(Scene(World((wall,), ground), {}, sensed, "wall"))
    while True:
        north, east, _ = link.poses[-1].position_ned_m
        attitude = matrix_from_euler(*link.attitude_rad)
        captured = camera.capture((north, east, -link.height_m), attitude, time.monotonic_ns(), 0.0)
        assert captured is not None
        writer.write(captured.frame)
        yield


def sticks(link: AutopilotLink, forward: list[int]) -> Iterator[None]:
    """The pilot's sticks. `forward`: the last value counts."""
    while True:
        link.send(dialect.MAVLink_manual_control_message(link.system_id, forward[-1], 0, 500, 0, 0))
        yield


def test_pilot_in_position_mode_stops_before_a_wall(
    link: AutopilotLink, services: Services, tmp_path: Path
) -> None:
    if link.autopilot != PX4:
        pytest.skip("collision prevention in Position mode is PX4's")
    bring_down(link)
    services.close()  # its own service takes the port
    before = set_for_test(link, {"CP_DIST": KEEP_M, "COM_RC_IN_MODE": 1.0})
    name, forward = f"sitl-{secrets.token_hex(6)}", [NEUTRAL]
    flags = [
        "--source", f"shm://{name}", "--detector-enabled", "false", "--driver", "pymavlink",
        "--camera-horizontal-fov-deg", "80", "--camera-mount-pitch-deg", "0",
        "--vehicle-system-id", str(link.system_id), "--guidance-min-battery-percent", "0",
        "--guidance-obstacles", "auto", "--guidance-send-obstacle-distance", "true",
    ]  # fmt: skip
    try:
        link.until(lambda: link.ready, READY_S, "ready to be armed")
        wall, start = wall_ahead(link), np.array(link.poses[-1].position_ned_m[:2])
        ahead = np.array(wall.position_ned_m[:2]) - start
        ahead /= np.linalg.norm(ahead)

        def left_m() -> float:
            """From the vehicle's centre to the wall."""
            return WALL_M - float((np.array(link.poses[-1].position_ned_m[:2]) - start) @ ahead)

        with (
            SharedFrameWriter(name, CAMERA.width, CAMERA.height, depth=True) as writer,
            repeated(0.1, frames(link, wall, writer)),
            running_service(link.service_port, flags, cwd=tmp_path) as service,
            service.client() as session,
            repeated(0.05, sticks(link, forward)),
        ):
            flight = Flight(link, service, session, "pymavlink")
            flight.take_off(3.0)
            link.set_mode(POSITION_MODE)
            link.until(lambda: link.modes[-1][1] == POSITION_MODE, 5.0, "in Position mode")
            begun_s = time.monotonic()
            forward.append(FULL)
            link.until(lambda: link.poses[-1].speed_mps > 1.0, 10.0, "flying forward")
            link.until(lambda: link.poses[-1].speed_mps < STANDING_MPS, 30.0, "standing before the wall")
            link.after(5.0)
            nearest_m = WALL_M - max(
                float((np.array(pose.position_ned_m[:2]) - start) @ ahead)
                for pose in link.trajectory(begun_s)
            )
            fastest = max(pose.speed_mps for pose in link.trajectory(begun_s))
            flight.note("pilot before a wall", nearest_m=nearest_m, stands_m=left_m(), fastest_mps=fastest)
            assert link.modes[-1][1] == POSITION_MODE
            assert KEEP_M - 1.0 < nearest_m <= left_m() < KEEP_M + 1.5
            bring_down(link)
    finally:
        bring_down(link)
        for parameter, value in before.items():
            link.set_parameter(parameter, value)
