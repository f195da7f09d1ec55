"""The other vehicles of a fleet in a vehicle's camera and in every truth file."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import secrets
import select
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil

from mavlink_sim.camera.aircraft_poses import SLOTS, SharedPoses
from mavlink_sim.camera.process import CameraProcess
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.camera.scene import Path as Way
from mavlink_sim.camera.simulated_camera import Captured, SimulatedCamera, frame_truth
from mavlink_sim.realtime.fleet import Fleet, instance_options
from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.realtime.simulation import run_together
from mavlink_sim.testing import free_port, free_udp_port_range, running_simulator
from mavlink_sim.vehicles.fleet_world import FleetWorld
from mavlink_sim.vehicles.vehicle import Vehicle
from mavlink_sim.world.aircraft import Aircraft, aircraft_objects, identifier_offset
from mavlink_sim.world.world import Ground, Light, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.shared_frame import SHARED_MEMORY_DIRECTORY, SharedFrameReader, segment_path

pytestmark = pytest.mark.realtime

needs_shared_memory = pytest.mark.skipif(
    not SHARED_MEMORY_DIRECTORY.is_dir(), reason="needs Linux's /dev/shm"
)
DEADLINE_S = 90.0
CAMERA = CameraModel.from_horizontal_fov(160, 120, math.radians(70.0))
WORLD = World(
    (WorldObject(0, "car", (12.0, 3.0, 0.0)), WorldObject(7, "box", (9.0, 5.0, 0.0))),
    Ground(("concrete",), 0, 256, 0.05),
)
SETTINGS = CameraSettings(CAMERA, CameraMount())
SCENE = Scene(WORLD, camera=SETTINGS)
EYE = (0.0, 0.0, -5.0)
LEVEL = np.eye(3)
HALF_DIAGONAL_M = 0.354
AHEAD = Aircraft(3, (6.0, 1.0, -5.0), yaw_rad=0.5)


def captured(camera: SimulatedCamera, *others: Aircraft, eye: tuple[float, float, float] = EYE) -> Captured:
    taken = camera.capture(eye, LEVEL, 1_000, 0.0, others=others)
    assert taken is not None
    return taken


def drones(taken: Captured) -> list[dict[str, Any]]:
    return [item for item in frame_truth(taken)["objects"] if item["class_name"] == "drone"]


# ---- the image


def test_other_vehicle_drawn_with_depth_and_truth() -> None:
    taken = captured(SimulatedCamera(SCENE), AHEAD, Aircraft(4, (-6.0, 0.0, -5.0)))  # the other is behind
    (entry,) = drones(taken)
    assert entry["system_id"] == 3
    assert entry["identifier"] == 10  # past the world's last, 7
    assert entry["position_ned_m"] == [6.0, 1.0, -5.0]
    assert entry["yaw_rad"] == 0.5
    assert entry["distance_m"] == pytest.approx(math.hypot(6.0, 1.0), abs=1e-3)
    assert 5.6 < entry["range_m"] < 6.0
    left, top, right, bottom = map(int, entry["xyxy"])
    column = CAMERA.cx + CAMERA.fx * 1.0 / 6.0
    row = CAMERA.cy - CAMERA.fy * 0.11 / 6.0  # half its height above its feet
    assert (left + right) / 2 == pytest.approx(column, abs=2.0)
    assert (top + bottom) / 2 == pytest.approx(row, abs=2.0)
    assert right - left == pytest.approx(CAMERA.fx * 0.5 / 6.0, abs=4.0)
    depth = taken.frame.depth_m
    assert depth is not None
    own = depth[top:bottom, left:right]
    own = own[own < 20.0]  # the background between its arms is far away
    assert own.size == entry["pixel_count"]
    assert own.min() > 6.0 - HALF_DIAGONAL_M
    assert own.max() < 6.0 + HALF_DIAGONAL_M
    empty = captured(SimulatedCamera(SCENE))
    changed = np.abs(taken.frame.image.astype(int) - empty.frame.image).max(axis=2) > 60
    assert changed[top:bottom, left:right].sum() > 0.5 * entry["pixel_count"]


def test_absent_vehicles_are_not_drawn() -> None:
    camera, alone = (
        SimulatedCamera(replace(SCENE, camera=replace(SETTINGS, effects=None))) for _ in range(2)
    )
    before = captured(alone).frame
    assert drones(captured(camera, AHEAD))
    after = captured(camera)
    assert not drones(after)
    assert np.array_equal(after.frame.image, before.image)
    assert after.frame.depth_m is not None
    assert before.depth_m is not None
    assert np.array_equal(after.frame.depth_m, before.depth_m, equal_nan=True)


def test_moving_objects_and_vehicles_are_both_drawn() -> None:
    path = Way(((9.0, -2.0, 0.0), (9.0, 2.0, 0.0)), 1.0)
    camera = SimulatedCamera(replace(SCENE, paths={7: path}))
    taken = captured(camera, AHEAD, eye=(0.0, 0.0, -2.0))
    assert {item["identifier"] for item in frame_truth(taken)["objects"]} >= {0, 7}
    assert len(drones(captured(camera, AHEAD))) == 1


def test_nearer_vehicle_hides_farther_one() -> None:
    far, near = Aircraft(4, (12.0, 0.0, -5.0)), Aircraft(5, (1.2, 0.0, -5.0))
    eye = (0.0, 0.0, -5.136)  # at the height of their bodies
    assert [item["system_id"] for item in drones(captured(SimulatedCamera(SCENE), far, eye=eye))] == [4]
    assert [item["system_id"] for item in drones(captured(SimulatedCamera(SCENE), far, near, eye=eye))] == [5]


@pytest.mark.parametrize("roll_rad", [-0.4, 0.4])
def test_vehicle_drawn_with_its_attitude(roll_rad: float) -> None:
    camera = CameraModel.from_horizontal_fov(320, 240, math.radians(30.0))
    scene = replace(SCENE, camera=CameraSettings(camera, CameraMount()))
    taken = captured(SimulatedCamera(scene), Aircraft(2, (2.0, 0.0, -4.89), roll_rad=roll_rad))
    (entry,) = drones(taken)
    assert entry["roll_rad"] == roll_rad
    depth = taken.frame.depth_m
    assert depth is not None
    columns = np.flatnonzero((depth < 2.5).any(axis=0))
    outermost = [np.flatnonzero(depth[:, column] < 2.5).mean() for column in (columns[0], columns[-1])]
    # seen from behind, the right side goes down with a positive roll
    lower = outermost[1] - outermost[0]
    span_px = columns[-1] - columns[0]
    assert lower / span_px == pytest.approx(math.tan(roll_rad), rel=0.25)


def test_upside_down_vehicle_drawn_on_ground() -> None:
    upright, fallen = (
        drones(captured(SimulatedCamera(SCENE), Aircraft(2, (4.0, 0.0, 0.0), roll), eye=(0.0, 0.0, -2.0)))
        for roll in (0.0, math.pi)
    )
    assert fallen[0]["pixel_count"] > 0.5 * upright[0]["pixel_count"]


@pytest.mark.parametrize(("roll_rad", "pitch_rad"), [(0.0, 0.0), (0.3, -0.2), (math.pi, 0.0)])
def test_vehicle_shadow_follows_sun(roll_rad: float, pitch_rad: float) -> None:
    light = Light(sun_azimuth_rad=math.radians(200.0), sun_elevation_rad=math.radians(50.0))
    world = World((), Ground(("concrete",), 0, 256, 0.05), light)
    down = CameraMount(pitch_rad=-math.pi / 2)
    north, east, down_m = 0.5, -0.4, -3.0
    item = aircraft_objects([Aircraft(2, (north, east, down_m), roll_rad, pitch_rad)], -1)
    eye = (north, east, down_m - 3.0)
    lit = Renderer(world, CAMERA, down).render(eye, LEVEL).image.astype(int)
    rendered = Renderer(replace(world, objects=item), CAMERA, down).render(eye, LEVEL)
    darker = (lit - rendered.image).mean(axis=2) > 12
    (left, top, right, bottom) = map(int, rendered.objects[0].xyxy)
    darker[top - 2 : bottom + 2, left - 2 : right + 2] = False  # itself
    rows, columns = np.nonzero(darker)
    assert len(rows) > 20
    throw_m = 3.11 / math.tan(light.sun_elevation_rad)  # from the middle of its height
    scale_px = CAMERA.fx / 6.0
    away_north = -throw_m * math.cos(light.sun_azimuth_rad) * scale_px  # up in an image of the ground
    away_east = -throw_m * math.sin(light.sun_azimuth_rad) * scale_px
    assert rows.mean() == pytest.approx(CAMERA.cy - away_north, abs=2.0)
    assert columns.mean() == pytest.approx(CAMERA.cx + away_east, abs=2.0)


def test_identifier_is_the_same_for_all_cameras() -> None:
    offset = identifier_offset(WORLD)
    everybody = [Aircraft(number, (0.0, 0.0, -5.0)) for number in (1, 2, 255)]
    assert [item.identifier for item in aircraft_objects(everybody, offset)] == [8, 9, 262]
    assert [item.identifier for item in aircraft_objects(everybody[1:], offset)] == [9, 262]
    assert [item.identifier for item in aircraft_objects(everybody, identifier_offset(World()))] == [
        0,
        1,
        254,
    ]


# ---- to the camera's process


def many(count: int, north: float = 0.0) -> list[Aircraft]:
    return [Aircraft(number + 1, (north, float(number), -5.0), 0.1, 0.2, 0.3) for number in range(count)]


def test_shared_poses_match_their_number_or_none() -> None:
    shared = SharedPoses(multiprocessing.get_context("spawn"), 249)
    numbers = []
    for number in range(SLOTS + 1):
        numbers.append(shared.write(many(249 - number, float(number))))
        shared.keep()
    assert len(set(numbers)) == SLOTS + 1
    assert shared.read(numbers[0]) is None  # written over
    for number in range(1, SLOTS + 1):
        assert shared.read(numbers[number]) == tuple(many(249 - number, float(number)))
    first = shared.write(many(1))
    assert shared.write(many(2)) == first  # the first was not sent: no older one is lost for it
    assert shared.read(numbers[2]) is not None
    assert shared.read(first) == tuple(many(2))
    assert shared.write([]) == first
    assert shared.read(first) == ()
    with pytest.raises(ValueError, match=r"250.*249"):
        shared.write(many(250))


@pytest.fixture
def name() -> Iterator[str]:
    chosen = f"test-fleet_world-{os.getpid()}-{secrets.token_hex(4)}"
    yield chosen
    segment_path(chosen).unlink(missing_ok=True)


class Lines:
    """JSON lines from a named pipe, as they arrive."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self._rest = b""

    def until(self, condition: Callable[[dict[str, Any]], bool], what: str) -> dict[str, Any]:
        """The first line that meets a condition."""
        deadline = time.monotonic() + DEADLINE_S
        while (left_s := deadline - time.monotonic()) > 0.0:
            line, newline, rest = self._rest.partition(b"\n")
            if newline:
                self._rest = rest
                value: dict[str, Any] = json.loads(line)
                if condition(value):
                    return value
            elif select.select([self._descriptor], [], [], left_s)[0]:
                came = os.read(self._descriptor, 65536)
                assert came, f"the camera ended before: {what}"
                self._rest += came
        raise AssertionError(f"not within {DEADLINE_S:g} s: {what}")

    def close(self) -> None:
        os.close(self._descriptor)


@needs_shared_memory
def test_newest_other_poses_reach_camera_process(name: str, tmp_path: Path) -> None:
    lines = Lines(tmp_path / "seen")
    camera = CameraProcess(SCENE, rate_hz=60.0, shared_name=name, truth=tmp_path / "seen", most_others=249)
    level = (1.0, 0.0, 0.0, 0.0)
    camera.start()
    try:
        crowd = [Aircraft(number, (30.0, 0.1 * number, -40.0)) for number in range(4, 252)]
        for number in range(300):  # more than the ring has slots, and than a pipe would take
            others = [AHEAD._replace(position_ned_m=(4.0 + 0.01 * number, 0.0, -5.0)), *crowd]
            camera.send_pose(EYE, level, 1 + number, 0.0, others=others)
        assert camera.dropped_poses == 0
        line = lines.until(lambda line: line["stamp_ns"] == 300, "a frame of the last pose")
        (seen,) = (item for item in line["objects"] if item.get("system_id") == 3)
        assert seen["position_ned_m"] == [6.99, 0.0, -5.0]
        with SharedFrameReader(name) as reader:
            frame = reader.latest()
        assert frame is not None
        assert frame.captured_ns == 300
        assert depth_within(frame, seen["xyxy"]) == pytest.approx(6.99, abs=HALF_DIAGONAL_M)
        camera.send_pose(EYE, level, 400, 0.0)
        line = lines.until(lambda line: line["stamp_ns"] == 400, "a frame without others")
        assert {item["class_name"] for item in line["objects"]} == {"car", "box"}
        with pytest.raises(ValueError, match="250 other aircraft"):
            camera.send_pose(EYE, level, 500, 0.0, others=[*crowd, AHEAD, AHEAD])
    finally:
        camera.stop()
        lines.close()


def depth_within(frame: Frame, xyxy: list[float]) -> float:
    left, top, right, bottom = map(int, xyxy)
    assert frame.depth_m is not None
    return float(np.nanmin(frame.depth_m[top:bottom, left:right]))


def test_a_camera_made_for_one_vehicle_refuses_others(name: str) -> None:
    camera = CameraProcess(SCENE, shared_name=name)
    try:
        with pytest.raises(ValueError, match="1 other aircraft"):
            camera.send_pose(EYE, (1.0, 0.0, 0.0, 0.0), 1, others=[AHEAD])
    finally:
        camera.stop()


# ---- the fleet


def test_vehicle_sees_all_others_in_world_frame() -> None:
    fleet_world = FleetWorld(3)
    vehicles = [Vehicle(system_id=5 + i, start_ned_m=(0.0, 10.0 * i), noise=False) for i in range(3)]
    for vehicle in vehicles:
        fleet_world.join(vehicle)
    vehicles[2].airframe.position = (1.0, 2.0, -3.0)
    vehicles[2].airframe.set_attitude(0.1, -0.2, 0.3)
    first, third = fleet_world.others(vehicles[1])
    assert (first.system_id, first.position_ned_m) == (5, (0.0, 0.0, 0.0))
    assert (third.system_id, third.position_ned_m) == (7, (1.0, 22.0, -3.0))
    assert third[2:] == pytest.approx((0.1, -0.2, 0.3))
    assert FleetWorld(1).others(vehicles[0]) == []


def test_all_vehicles_drawn_at_one_time(tmp_path: Path) -> None:
    """Each vehicle's truth and the other's entry of it at the same time agree to the millimetre."""
    options = SimulationOptions(
        onboard_port=free_udp_port_range(2),
        onboard_bind=0,
        gcs_port=free_port(),
        gcs_bind=0,
        ready_after_s=0.0,
        noise=False,
        truth=tmp_path / "truth.jsonl",
        speed=4.0,
    )
    with Fleet(instance_options(options, 2, 6.0), lambda text: None) as fleet:
        for simulation in fleet:
            simulation.vehicle.step(0.5)
            simulation.vehicle.autopilot.arm()
            simulation.vehicle.autopilot.takeoff(20.0)
            simulation.vehicle.step(6.0)
            for link in simulation.vehicle.links:
                simulation.vehicle.outgoing(link)
        watched = fleet.simulations[0].vehicle
        until_s = watched.now_s + 0.5
        run_together(fleet.simulations, lambda: watched.now_s > until_s, lambda text: None)
    first, second = (
        [json.loads(line) for line in (tmp_path / file).read_text().splitlines()]
        for file in ("truth.jsonl", "truth-2.jsonl")
    )
    assert len(first) == len(second) >= 5
    assert abs(first[-1]["velocity_ned_mps"][2]) > 0.5  # a step of 4 ms would show
    for here, there, start in ((first, second, (0.0, 6.0)), (second, first, (0.0, 0.0))):
        for mine, own in zip(here, there, strict=True):
            (seen,) = (item for item in mine["objects"] if "system_id" in item)
            north, east, down = own["position_ned_m"]
            assert mine["stamp_ns"] == own["stamp_ns"]
            assert seen["class_name"] == "drone"
            assert seen["position_ned_m"] == pytest.approx(
                [start[0] + north, start[1] + east, down], abs=6e-4
            )
            assert 5.0 < seen["range_m"] < 6.5
    assert {item["system_id"] for line in first for item in line["objects"] if "system_id" in item} == {2}
    assert {item["system_id"] for line in second for item in line["objects"] if "system_id" in item} == {1}


FIELD = """
[ground]
kinds = ["concrete"]
tile_texels = 256
[[objects]]
class = "car"
place_m = [0, 14]
[camera]
width = 160
height = 120
rate_hz = 20
[camera.mount]
yaw_deg = 90
pitch_deg = 10
"""


@needs_shared_memory
def test_a_camera_in_a_fleet_watches_another_vehicle_take_off(name: str, tmp_path: Path) -> None:
    scene = tmp_path / "field.toml"
    scene.write_text(FIELD, "utf-8")
    lines = Lines(tmp_path / "seen")

    def other(line: dict[str, Any]) -> dict[str, Any]:
        (entry,) = (item for item in line["objects"] if item["class_name"] == "drone")
        return dict(entry)

    try:
        with running_simulator(
            vehicles=2,
            spacing=6.0,
            camera=name,
            camera_truth=tmp_path / "seen",
            truth=tmp_path / "truth.jsonl",
            scene=scene,
            speed=4.0,
            ready_after=0.0,
            noise="off",
            gusts=0.0,
        ) as simulator:
            standing = other(lines.until(lambda line: True, "a first frame"))
            assert (standing["system_id"], standing["position_ned_m"]) == (2, [0.0, 6.0, 0.0])
            assert standing["identifier"] == 2  # the car is 0, the first vehicle would be 1
            link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{simulator.vehicles[1].onboard_port}")
            link.wait_heartbeat(timeout=30)
            link.mav.command_long_send(2, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
            simulator.wait_for_event("vehicle 2: armed")
            link.mav.command_long_send(2, 1, 22, 0, math.nan, 0, 0, math.nan, *(math.nan,) * 3)
            link.close()

            def is_up(line: dict[str, Any]) -> bool:
                entries = [item for item in line["objects"] if item["class_name"] == "drone"]
                return bool(entries) and entries[0]["position_ned_m"][2] < -1.0

            line = lines.until(is_up, "the other one in the air")
            with SharedFrameReader(name) as reader:
                while True:  # the frame of that line, unless the next one has come meanwhile
                    frame = reader.latest()
                    assert frame is not None
                    if frame.captured_ns == line["stamp_ns"]:
                        break
                    line = lines.until(is_up, "the next frame")
    finally:
        lines.close()
    seen = other(line)
    assert seen["position_ned_m"][1] == pytest.approx(6.0, abs=0.2)
    assert seen["distance_m"] == pytest.approx(math.hypot(6.0, seen["position_ned_m"][2]), abs=0.3)
    left, top, right, bottom = seen["xyxy"]
    assert bottom < 80.0  # above the horizon
    assert left < 80.0 < right
    assert depth_within(frame, seen["xyxy"]) == pytest.approx(5.8, abs=0.4)
    depth = frame.depth_m
    assert depth is not None
    assert np.isnan(depth[int(top) - 3, int(left) : int(right)]).all()  # the sky above it
    events = [json.loads(text) for text in (tmp_path / "truth.jsonl").read_text().splitlines()]
    assert {item.get("system_id") for entry in events for item in entry["objects"]} == {None, 2}
    events = [json.loads(text) for text in (tmp_path / "truth-2.jsonl").read_text().splitlines()]
    assert {item.get("system_id") for entry in events for item in entry["objects"]} == {None, 1}
    assert min(entry["position_ned_m"][2] for entry in events) < -1.0
