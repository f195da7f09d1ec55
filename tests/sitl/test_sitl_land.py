"""Landings on a marker's pad, on the PX4 at COMPANION_SITL_URL whose simulation sends its true pose."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.flights_land import (
    ALLOWED_M,
    DICTIONARY,
    LARGE,
    MAX_ACCELERATION_MPS2,
    MIDDLE,
    OFFSETS_M,
    SIZES_M,
    Pad,
)
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.camera.simulated_camera import SimulatedCamera
from mavlink_sim.world.world import Ground, World
from tests.companion.service_process import running_service
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import READY_S, AutopilotLink, Flight, Truth, bring_down, repeated, true_poses
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_quaternion
from vision.shared_frame import SharedFrameWriter

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
CAMERA = CameraModel.from_horizontal_fov(400, 300, math.radians(75.0))
MOUNT = CameraMount(forward_m=0.08, down_m=0.05, pitch_rad=-math.pi / 2)
PERIOD_S, LATENCY_S, HEIGHT_M, LANDINGS = 0.08, 0.08, 5.0, 5
SETTLED_S = 1.0


def frames(pad: Pad, truth: Truth, writer: SharedFrameWriter) -> Iterator[None]:
    """Draw the pad from the true pose, and share the image `LATENCY_S` later."""
    lens = CameraSettings(model=CAMERA, mount=MOUNT)
    camera = SimulatedCamera(Scene(World(pad.plates(), Ground(("concrete",), 5, 256, 0.05)), {}, lens, "pad"))
    while True:
        captured_s = time.monotonic() - LATENCY_S
        time_s, pose = min(truth.poses[-50:], key=lambda item: abs(item[0] - captured_s))
        captured = camera.capture(
            pose.position, matrix_from_quaternion(pose.attitude), round(time_s * 1e9), 0.0
        )
        assert captured is not None
        writer.write(captured.frame)
        yield


@pytest.mark.parametrize("landing", range(LANDINGS))
def test_rests_on_the_pad_of_a_marker(
    link: AutopilotLink, services: Services, tmp_path: Path, landing: int
) -> None:
    rng = np.random.default_rng((landing, 149))
    name = f"sitl-{secrets.token_hex(6)}"
    (right_m, above_m), size_m = OFFSETS_M[LARGE], SIZES_M[MIDDLE]
    flags = [
        "--source", f"shm://{name}", "--detector-enabled", "false",
        "--camera-horizontal-fov-deg", "75", "--camera-mount-pitch-deg", "-90",
        "--camera-mount-forward-m", f"{MOUNT.forward_m}", "--camera-mount-down-m", f"{MOUNT.down_m}",
        "--vehicle-system-id", str(link.system_id), "--guidance-min-battery-percent", "0",
        "--markers-dictionary", DICTIONARY, "--markers-size-m", f"{size_m}",
        "--markers-others", f"{LARGE}:{SIZES_M[LARGE]}@{MIDDLE}:{right_m}:{above_m}",
        "--guidance-max-acceleration-mps2", f"{MAX_ACCELERATION_MPS2:g}", "--guidance-obstacles", "off",
    ]  # fmt: skip
    with true_poses(link) as truth:
        bring_down(link)
        services.close()  # its own service takes the port
        link.until(lambda: link.ready, READY_S, "ready to be armed")
        away, direction, yaw = rng.uniform(0.0, 3.0), *rng.uniform(-math.pi, math.pi, 2)
        north, east, _ = truth.poses[-1][1].position
        pad = Pad((north + away * math.cos(direction), east + away * math.sin(direction)), float(yaw))
        try:
            with (
                SharedFrameWriter(name, CAMERA.width, CAMERA.height, depth=True) as writer,
                repeated(PERIOD_S, frames(pad, truth, writer)),
                running_service(link.service_port, flags, cwd=tmp_path) as service,
                service.client() as session,
            ):
                flight = Flight(link, service, session, "pymavlink")
                flight.take_off(HEIGHT_M)
                begun_s = time.monotonic()
                reply = flight.fly(f"land-on-marker {MIDDLE}", 200.0)
                took_s = time.monotonic() - begun_s
                link.after(SETTLED_S)
                rests = truth.poses[-1][1].position
                error_m = math.dist(rests[:2], pad.place(0.0))
                flight.note(f"landing {landing} on a pad", error_m=error_m, time_s=took_s)
                print(landing, round(error_m, 3), round(took_s, 1), reply["reason"])
                assert link.grounded
                assert error_m <= ALLOWED_M
        finally:
            bring_down(link)
