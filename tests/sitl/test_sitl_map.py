"""A map of markers instead of GNSS, on the PX4 at COMPANION_SITL_URL whose simulation sends its true pose."""

from __future__ import annotations

import itertools
import math
import secrets
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.camera.simulated_camera import SimulatedCamera
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.structures import PLATE_THICKNESS_M
from mavlink_sim.world.world import Ground, World, WorldObject
from tests.companion.service_process import running_service
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import (
    PX4,
    READY_S,
    AutopilotLink,
    Flight,
    Truth,
    bring_down,
    repeated,
    set_for_test,
    true_poses,
)
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_quaternion
from vision.shared_frame import SharedFrameWriter

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
CAMERA = CameraModel.from_horizontal_fov(400, 300, math.radians(80.0))
MOUNT = CameraMount(pitch_rad=math.radians(-80.0))
DICTIONARY, SIZE_M, PERIOD_S, HEIGHT_M = "APRILTAG_36h11", 0.4, 0.08, 3.0
# North, east and the upper edge's direction: a mat of 5 x 5 markers, printed in different orientations.
MAT = [(1.5 * (row - 1), 1.5 * (column - 2), 0.7 * (row + column)) for row in range(5) for column in range(5)]
# Position and yaw are fused from vision; PX4's clock is not the service's, so that the delay is constant.
VISION = {"EKF2_EV_CTRL": 9.0, "EKF2_EV_DELAY": 80.0}
# PX4 stops using GNSS some seconds after its last fix, and resets its position to the map's.
SETTLED_S = 12.0


def frames(truth: Truth, writer: SharedFrameWriter) -> Iterator[None]:
    """Draw the mat from the true pose, and share the image."""
    plates = tuple(
        WorldObject(number, "plate", (north, east, 0.0), yaw, printed=Print(DICTIONARY, number, SIZE_M))
        for number, (north, east, yaw) in enumerate(MAT)
    )
    ground = Ground(("concrete",), 5, 256, 0.05)
    lens = CameraSettings(model=CAMERA, mount=MOUNT)
    camera = SimulatedCamera(Scene(World(plates, ground), {}, lens, "mat"))
    while True:
        time_s, pose = truth.poses[-1]
        attitude = matrix_from_quaternion(pose.attitude)
        captured = camera.capture(pose.position, attitude, round(time_s * 1e9), 0.0)
        assert captured is not None
        writer.write(captured.frame)
        yield


def map_text(origin_ned_m: tuple[float, float, float]) -> str:
    """The mat in the autopilot's local NED, where the simulation's beginning has this place."""
    north_m, east_m, down_m = origin_ned_m
    return "".join(
        f"[[markers]]\nid = {number}\nsize_m = {SIZE_M}\nyaw_deg = {math.degrees(yaw)}\n"
        f"position_m = [{north + north_m}, {east + east_m}, {down_m - PLATE_THICKNESS_M}]\n"
        for number, (north, east, yaw) in enumerate(MAT)
    )


def test_without_gnss_above_a_map_the_vehicle_keeps_its_place(
    link: AutopilotLink, services: Services, tmp_path: Path
) -> None:
    if link.autopilot != PX4:
        pytest.skip("the parameters of this test are PX4's")
    reading = ExitStack()
    truth = reading.enter_context(true_poses(link))
    bring_down(link)
    services.close()  # its own service takes the port
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    estimate, begun = link.poses[-1].position_ned_m, truth.poses[-1][1].position
    origin = tuple(there - here for there, here in zip(estimate, begun, strict=True))
    (tmp_path / "map.toml").write_text(map_text((origin[0], origin[1], origin[2])))
    before = set_for_test(link, VISION)
    name = f"sitl-{secrets.token_hex(6)}"
    flags = [
        "--source", f"shm://{name}", "--detector-enabled", "false", "--driver", "pymavlink",
        "--camera-horizontal-fov-deg", "80", "--camera-mount-pitch-deg", "-80",
        "--vehicle-system-id", str(link.system_id), "--guidance-min-battery-percent", "0",
        "--markers-dictionary", DICTIONARY, "--markers-map-file", "map.toml", "--markers-localise", "true",
        "--guidance-obstacles", "off",
    ]  # fmt: skip

    def place(time_s: float) -> tuple[float, float]:
        """The true one at that time, in the autopilot's local NED."""
        north, east = truth.at(time_s)
        return north + origin[0], east + origin[1]

    try:
        with (
            SharedFrameWriter(name, CAMERA.width, CAMERA.height, depth=True) as writer,
            repeated(PERIOD_S, frames(truth, writer)),
            running_service(link.service_port, flags, cwd=tmp_path) as service,
            service.client() as session,
        ):
            flight = Flight(link, service, session, "pymavlink")
            flight.take_off(HEIGHT_M)
            before |= set_for_test(link, {"SIM_GPS_USED": 0.0})
            link.after(SETTLED_S)
            errors, away, sent = [], [], []
            for north, east in itertools.islice(itertools.cycle([(2.0, 1.0), (0.5, -1.0)]), 4):
                goal = (north + origin[0], east + origin[1])
                ahead, aside = goal[0] - link.home_ned_m[0], goal[1] - link.home_ned_m[1]
                flight.fly(f"goto {ahead:.3f} {aside:.3f} altitude={HEIGHT_M:g}")
                for _ in range(40):
                    link.after(0.1)
                    errors.append(math.dist(link.poses[-1].position_ned_m[:2], place(link.poses[-1].time_s)))
                    away.append(math.dist(place(link.poses[-1].time_s), goal))
                    captured_s, *vision = link.visions[-1]
                    sent.append(math.dist(vision, place(captured_s)))
            estimate_m, away_m = (float(np.percentile(values, 95)) for values in (errors, away))
            flight.note(
                "a map without GNSS", sent_max_m=max(sent), estimate_p95_m=estimate_m, goal_p95_m=away_m
            )
            assert max(sent) < 0.1
            assert estimate_m < 0.5
            assert away_m < 0.3 + 0.5  # the arrival's tolerance, and the estimate's
    finally:
        for parameter, value in before.items():
            link.set_parameter(parameter, value)
        bring_down(link)
        reading.close()
