"""OBSTACLE_DISTANCE as bytes, and a pilot in Position mode before a wall that only our camera sees."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from benchmarks.flights_obstacles import CAMERA, MOUNT
from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.vehicle.driver import Driver
from companion.vehicle.obstacle_distance import MAXIMUM_CM, UNKNOWN_CM, obstacle_distance_fields
from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.world.world import Ground, World, WorldObject
from tests.companion.vehicle.fake_autopilot import FakeAutopilot, wait_for_state
from tests.mavlink_sim.conftest import CALIBRATION
from vision.obstacle_sectors import SECTORS, ObstacleSectors

# In wire order: time_usec, distances, min_distance, max_distance, sensor_type, increment, then the extension
# increment_f, angle_offset, frame.
LAYOUT = struct.Struct("<Q72H2H2B2fB")
FREE_CM = MAXIMUM_CM + 1
WALL_M = 9.0


def sectors(near: dict[int, float]) -> ObstacleSectors:
    return ObstacleSectors(5_000_123_000, tuple(near.get(index, math.inf) for index in range(SECTORS)))


def payload(seen: ObstacleSectors, yaw_rad: float) -> tuple[float, ...]:
    codec = common.MAVLink(None, srcSystem=1, srcComponent=191)
    message = common.MAVLink_obstacle_distance_message(**obstacle_distance_fields(seen, yaw_rad))
    packed = bytes(message.pack(codec))
    assert packed[0] == 0xFD
    assert packed[7:10] == (330).to_bytes(3, "little")
    return LAYOUT.unpack(packed[10 : 10 + packed[1]].ljust(LAYOUT.size, b"\0"))


def test_sectors_are_packed_in_centimetres() -> None:
    near = {0: 3.0, 1: math.nan, 2: 25.0, 3: 0.02, 71: 1.234}
    time_us, *distances, minimum, maximum, kind, increment, fine, offset, frame = payload(sectors(near), 0.0)
    assert time_us == 5_000_123
    assert distances == [300, 65535, FREE_CM, 11, *[FREE_CM] * 67, 123]
    assert (minimum, maximum, increment, fine, offset) == (10, 2000, 5, 5.0, 0.0)
    assert (kind, frame) == (common.MAV_DISTANCE_SENSOR_UNKNOWN, common.MAV_FRAME_BODY_FRD)


@given(yaw_rad=st.floats(-10.0, 10.0), sector=st.integers(0, SECTORS - 1))
def test_obstacle_keeps_its_direction_at_any_yaw(yaw_rad: float, sector: int) -> None:
    _, *distances, _, _, _, _, _, offset_deg, _ = payload(sectors({sector: 4.0}), yaw_rad)
    assert abs(offset_deg) <= 2.5 + 1e-6
    shown_rad = math.radians(5.0 * distances.index(400) + offset_deg) + yaw_rad
    assert math.cos(shown_rad - math.radians(5.0 * sector)) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.realtime
@pytest.mark.usefixtures("short_measurement")
async def test_both_drivers_send_obstacle_distance(driver: Driver, autopilot: FakeAutopilot) -> None:
    driver.send_obstacle_distance(sectors({}))  # no attitude yet: nothing is sent
    half_rad = math.radians(92.0) / 2
    quaternion = (math.cos(half_rad), 0.0, 0.0, math.sin(half_rad))
    autopilot.send(common.MAVLink_attitude_quaternion_message(1000, *quaternion, 0.0, 0.0, 0.0))
    await wait_for_state(driver, lambda state: state.yaw_rad is not None)
    driver.send_obstacle_distance(sectors({18: 3.0, 20: math.nan}))
    (message,) = await autopilot.wait_for("OBSTACLE_DISTANCE")
    assert list(message.distances[:3]) == [300, FREE_CM, UNKNOWN_CM]
    assert message.angle_offset == pytest.approx(-2.0, abs=1e-3)
    assert (message.frame, message.increment_f, message.max_distance) == (12, 5.0, MAXIMUM_CM)


@pytest.mark.parametrize("send", [True, False])
def test_pilot_in_position_mode_stops_before_a_wall(send: bool) -> None:
    flags = {"detector.enabled": "false", "guidance.send_obstacle_distance": str(send)}
    settings = camera_settings(CAMERA, MOUNT, flags)
    wall = WorldObject(0, "wall", (WALL_M, 0.0, 0.0), math.pi, size_m=(30.0, 0.4, 6.0))
    sensed = CameraSettings(model=CAMERA, mount=MOUNT, depth=DepthSensor(), seed=1)
    scene = Scene(World((wall,), Ground(("concrete",), 0, 256, 0.05)), {}, sensed, "wall")
    flight = LockstepFlight.airborne(
        seed=1,
        height_m=2.5,
        camera=lambda vehicle: RenderedCamera(settings, scene, vehicle),
        parameters={**CALIBRATION, "COM_RC_IN_MODE": 0, "CP_DIST": 3.0, "CP_GUIDE_ANG": 0.0},
    )
    pilot = flight.vehicle.vehicle.transmitter
    pilot.on = True
    flight.run(1.0)
    flight.turn_to(0.0)
    flight.vehicle.set_mode("POSCTL")
    pilot.sticks = Sticks(pitch=1.0)
    flight.run(8.0 if send else 5.0)
    truth = flight.vehicle.truth
    assert truth.mode == ("POSCTL" if send else "HOLD")
    left_m = WALL_M - 0.2 - truth.position_ned_m[0]
    # Without data PX4 does not move, and changes to HOLD.
    assert (2.2 < left_m < 4.0) if send else left_m > WALL_M - 2.0
