"""A map of markers gives the vehicle's position: geometry, messages, and flights without GNSS in lockstep."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import TICK_S, LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.geometry.geodesy import latitude_longitude
from companion.guidance.objects.from_detections import StateHistory
from companion.perception.map_position import map_origin_ned_m, position_from_map
from companion.settings.marker_files import read_map
from companion.vehicle.state import Vector3, VehicleState
from companion.vehicle.vision_position import VisionPosition, vision_position_fields
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.structures import PLATE_THICKNESS_M
from mavlink_sim.world.world import Ground, World, WorldObject
from tests.companion.guidance.guidance_harness import assert_succeeded, known
from vision.attitude import quaternion_from_euler, wrap_angle
from vision.camera_model import CameraModel, CameraMount
from vision.marker_boards import Board, locate_board
from vision.marker_edges import CORNER_SIGMA_PX
from vision.markers import Marker, marker_from_corners
from vision.rotation import matrix_from_euler

CAMERA = CameraModel.from_horizontal_fov(400, 300, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, down_m=0.05, pitch_rad=math.radians(-80.0))
DICTIONARY, SIZE_M = "APRILTAG_36h11", 0.4
# A mat of 5 x 5 markers every 1.5 m, printed in different orientations.
MAT = {
    5 * row + column: (1.5 * (row - 1), 1.5 * (column - 2), 0.7 * (row + column))
    for row in range(5)
    for column in range(5)
}
LATENCY_S = 0.1


def map_text(origin: str = "") -> str:
    return origin + "".join(
        f"[[markers]]\nid = {identifier}\nsize_m = {SIZE_M}\n"
        f"position_m = [{north}, {east}, {-PLATE_THICKNESS_M}]\nyaw_deg = {math.degrees(yaw)}\n"
        for identifier, (north, east, yaw) in MAT.items()
    )


def flight_above(
    tmp_path: Path, seed: int, *, localise: bool = True, control: int = 9, rate_hz: float = 12.0
) -> LockstepFlight:
    file = tmp_path / "map.toml"
    file.write_text(map_text())
    plates = tuple(
        WorldObject(
            identifier, "plate", (north, east, 0.0), yaw, printed=Print(DICTIONARY, identifier, SIZE_M)
        )
        for identifier, (north, east, yaw) in MAT.items()
    )
    lens = CameraSettings(model=CAMERA, mount=MOUNT, seed=seed)
    scene = Scene(World(plates, Ground(("concrete",), seed, 256, 0.05)), {}, lens, "mat")
    settings = camera_settings(
        CAMERA,
        MOUNT,
        {
            "detector.enabled": "false",
            "markers.dictionary": DICTIONARY,
            "markers.map_file": str(file),
            "markers.localise": str(localise).lower(),
        },
    )

    def camera(vehicle: LockstepVehicle) -> RenderedCamera:
        return RenderedCamera(settings, scene, vehicle, rate_hz=rate_hz, latency_s=LATENCY_S, depth=False)

    parameters = {"EKF2_EV_CTRL": control, "EKF2_EV_DELAY": LATENCY_S * 1000.0}
    return LockstepFlight.airborne(
        seed=seed, height_m=3.0, wind_mps=2.0, camera=camera, parameters=parameters
    )


def error_m(flight: LockstepFlight) -> float:
    """Horizontally, of what the autopilot believes."""
    return math.dist(flight.vehicle.vehicle.estimate.position[:2], flight.vehicle.truth.position_ned_m[:2])


@pytest.fixture
def board(tmp_path: Path) -> Board:
    file = tmp_path / "map.toml"
    file.write_text(map_text())
    return read_map(file)


def history_of(position: Vector3, euler: tuple[float, float, float]) -> StateHistory:
    history = StateHistory()
    history.add(
        VehicleState(
            attitude_ns=1000, position_ns=1000, attitude=quaternion_from_euler(*euler),
            position_ned_m=position, home_position_ned_m=(0.0, 0.0, 0.0),
        )
    )  # fmt: skip
    return history


def seen_from(
    board: Board, position: Vector3, euler: tuple[float, float, float], rng: np.random.Generator, most: int
) -> VisionPosition:
    """The position from at most so many markers with noisy corners; the autopilot's tilt is 0.5° off."""
    ned_from_body = matrix_from_euler(*euler)
    optical_from_ned = MOUNT.ned_from_optical(ned_from_body).T
    eye = np.array(position) + ned_from_body @ MOUNT.position_frd_m
    markers: list[Marker] = []
    for identifier, corners in board.corners_m.items():
        pixels = CAMERA.project((corners - eye) @ optical_from_ned.T)
        inside = (pixels > 5).all() and (pixels < (CAMERA.width - 5, CAMERA.height - 5)).all()
        if inside and len(markers) < most:
            noisy = pixels + rng.normal(0.0, CORNER_SIGMA_PX, (4, 2))
            marker = known(marker_from_corners(identifier, noisy, SIZE_M, CAMERA))
            markers.append(marker)
    located = known(locate_board(board, markers, CAMERA))
    reported = (euler[0] + rng.normal(0.0, 0.009), euler[1] + rng.normal(0.0, 0.009), 2.0)
    return known(
        position_from_map(located, 1000, MOUNT, history_of((0.0, 0.0, 0.0), reported), (0.0, 0.0, 0.0))
    )


@pytest.mark.parametrize(("most", "allowed_m"), [(1, 0.15), (25, 0.05)])
def test_position_and_heading_from_a_map_for_any_attitude(board: Board, most: int, allowed_m: float) -> None:
    """The heading is the map's; the autopilot's is wrong here."""
    rng, inside = np.random.default_rng(4), []
    for _ in range(60):
        position = (rng.uniform(0, 2), rng.uniform(-1, 1), rng.uniform(-4, -2))
        euler = (rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(-3, 3))
        vision = seen_from(board, position, euler, rng, most)
        off = np.subtract(vision.position_ned_m, position)
        assert np.linalg.norm(off) < allowed_m
        assert abs(wrap_angle(vision.euler_rad[2] - euler[2])) < math.radians(2.0)
        sigma = np.sqrt(np.array(vision.covariance)[[0, 6, 11]])
        inside.append(np.abs(off) < sigma)
    assert 0.55 < float(np.mean(inside)) < 0.85


def test_map_that_contradicts_the_tilt_gives_no_position(board: Board) -> None:
    corners = board.corners_m[12]
    pixels = CAMERA.project(corners @ cv2.Rodrigues(np.array([0.9, 0.0, 0.0]))[0].T + [-1.0, 0.5, 3.0])
    marker = known(marker_from_corners(12, pixels, SIZE_M, CAMERA))
    located = known(locate_board(board, [marker], CAMERA))
    history = history_of((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert position_from_map(located, 1000, MOUNT, history, (0.0, 0.0, 0.0)) is None


def test_origin_on_the_earth_is_found_in_local_ned() -> None:
    latitude, longitude = latitude_longitude((47.4, 8.5), 12.0, -7.0)
    state = VehicleState(
        position_ned_m=(2.0, 3.0, -4.0), reset_offset_ned_m=(0.5, 0.0, 0.0), position_ns=10**9,
        velocity_ned_mps=(1.0, 0.0, 0.0), global_ns=10**9 + 10**8,
        latitude_deg=47.4, longitude_deg=8.5, altitude_amsl_m=492.0,
    )  # fmt: skip
    origin = map_origin_ned_m((latitude, longitude, 488.0), state)
    # The vehicle is at (2.6, 3, -4) of the autopilot's own local NED when it is at this latitude.
    assert origin == pytest.approx((14.6, -4.0, 0.0), abs=0.01)
    assert map_origin_ned_m((latitude, longitude, 488.0), VehicleState()) is None
    assert map_origin_ned_m(None, VehicleState()) == (0.0, 0.0, 0.0)


def test_message_has_the_capture_time_pose_and_covariance() -> None:
    covariance = tuple(float(index + 1) for index in range(21))
    fields = vision_position_fields(
        VisionPosition(5_000_000_123, (1.0, 2.0, -3.0), (0.1, 0.2, 0.3), covariance)
    )
    assert fields == {
        "usec": 5_000_000, "x": 1.0, "y": 2.0, "z": -3.0, "roll": 0.1, "pitch": 0.2, "yaw": 0.3,
        "covariance": list(covariance), "reset_counter": 0,
    }  # fmt: skip
    with pytest.raises(ValueError, match="finite"):
        VisionPosition(0, (math.nan, 0.0, 0.0), (0.0, 0.0, 0.0), covariance)


@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.slow), 6])
def test_without_gnss_above_a_map_the_vehicle_holds_0_3_m(tmp_path: Path, seed: int) -> None:
    flight = flight_above(tmp_path, seed, rate_hz=6.0)
    flight.run(1.0)
    flight.vehicle.vehicle.faults.begin("gps_loss")
    flight.run(0.5)
    errors: list[float] = []
    log = flight.fly(
        "goto 2 1 altitude=3", 20.0, on_tick=lambda: errors.append(error_m(flight)), warm_up_s=0.0
    )
    assert_succeeded(log.outcome)
    identifier = flight.command("hold")
    away: list[float] = []
    for _ in range(round(4.0 / TICK_S)):
        flight.tick()
        errors.append(error_m(flight))
        away.append(math.dist(flight.vehicle.truth.position_ned_m[:2], (2.0, 1.0)))
    assert flight.outcome(identifier) is not None
    assert max(errors) < 0.3
    assert max(away) < 0.3 + 0.3  # the arrival's tolerance, and the estimate's
    assert flight.vehicle.vehicle.vision.position_fused
    assert flight.state.position_valid is not False


@pytest.mark.parametrize(("localise", "control"), [(False, 9), (True, 0)])
def test_without_localise_or_fusion_the_position_is_lost(
    tmp_path: Path, localise: bool, control: int
) -> None:
    flight = flight_above(tmp_path, 1, localise=localise, control=control, rate_hz=1.0)
    flight.vehicle.vehicle.faults.begin("gps_loss")
    flight.run(7.0)
    assert not flight.vehicle.vehicle.vision.position_fused
    assert not flight.vehicle.vehicle.estimate.position_valid
