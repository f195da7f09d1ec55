"""The rendered camera with the product's perception in lockstep, against the processes of a real-time run."""

from __future__ import annotations

import math
import os
import secrets
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from companion.bench.rendered_perception import RenderedPerception
from companion.perception.messages import Attitude, Report
from companion.perception.process import PerceptionProcess
from companion.settings import Settings
from companion.settings.reading import load_settings
from mavlink_sim.camera.process import CameraProcess
from mavlink_sim.camera.scene_file import scene_or_demo
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.world.world import Ground
from vision.frame import Frame
from vision.pipeline import PerceptionResult
from vision.shared_frame import SharedFrameReader, SharedFrameWriter, segment_path

pytestmark = pytest.mark.realtime

SEED = 1
DEADLINE_S = 60.0
CAMERA = {
    "camera.horizontal_fov_deg": "70",
    "camera.mount_pitch_deg": "-20",
    "camera.mount_forward_m": "0.12",
    "detector.image_size": "320",
    "detector.threads": "1",
}
# The demonstration's, on a ground that is painted soon, also by the camera's process.
DEMO = scene_or_demo(None, SEED)
SCENE = replace(DEMO, world=replace(DEMO.world, ground=Ground(("grass",), SEED, 256, 0.1)))


def settings_of(**changes: str) -> Settings:
    named = {key.replace("__", "."): value for key, value in changes.items()}
    return load_settings(os.devnull, CAMERA | named, environment={})


@pytest.fixture(scope="module")
def airborne() -> LockstepVehicle:
    vehicle = LockstepVehicle(seed=SEED)
    vehicle.take_off(4.0)
    return vehicle


@pytest.fixture
def segment() -> Iterator[str]:
    name = f"test-perception-{os.getpid()}-{secrets.token_hex(4)}"
    yield name
    segment_path(name).unlink(missing_ok=True)


def add_attitude(perception: RenderedPerception, vehicle: LockstepVehicle, now_ns: int) -> None:
    perception.add_attitude(now_ns, vehicle.truth.quaternion, vehicle.truth.height_m)


def flown(seed: int, frames: int) -> list[PerceptionResult]:
    """By a vehicle of that seed in one world."""
    vehicle = LockstepVehicle(seed=seed)
    vehicle.take_off(4.0)
    perception = RenderedPerception(settings_of(), vehicle, SCENE)
    results = []
    for _ in range(frames):
        vehicle.step(0.1)
        now_ns = round(vehicle.now_s * 1e9)
        add_attitude(perception, vehicle, now_ns)
        result = perception.look(now_ns)
        assert result is not None
        results.append(replace(result, timing_ms={}))
    return results


def rows(result: PerceptionResult) -> tuple[object, ...]:
    return (result.captured_ns, result.detections.records(), result.track_events)


def test_same_seed_gives_same_results() -> None:
    first, second = flown(SEED, 4), flown(SEED, 4)
    assert [rows(result) for result in first] == [rows(result) for result in second]
    (other,) = flown(SEED + 1, 1)
    assert first[0].detections.records() != other.detections.records()
    assert any("confirmed" in str(record["track_state"]) for record in first[-1].detections.records())


def test_stamps_are_of_the_simulated_clock(airborne: LockstepVehicle) -> None:
    perception = RenderedPerception(settings_of(), airborne, SCENE)
    captured = perception.capture(5_000_000_000)
    assert captured is not None
    result = perception.process(captured.frame, 5_080_000_000)
    assert result is not None
    assert (result.captured_ns, result.inferred_ns) == (5_000_000_000, 5_080_000_000)


def test_frames_above_the_rate_are_left_out(airborne: LockstepVehicle) -> None:
    perception = RenderedPerception(settings_of(detector__rate_hz="2"), airborne, SCENE)
    captured = perception.capture(5_000_000_000)
    assert captured is not None
    processed = []
    for number in range(4):
        stamp_ns = 5_000_000_000 + number * 250_000_000
        frame = replace(captured.frame, sequence=number, captured_ns=stamp_ns)
        processed.append(perception.process(frame, stamp_ns) is not None)
    assert processed == [True, False, True, False]


def test_frame_is_the_camera_process_s_frame(airborne: LockstepVehicle, segment: str) -> None:
    """The first of a real-time run for the same seed and pose, the sensor's noise included."""
    perception = RenderedPerception(settings_of(), airborne, SCENE)
    stamp_ns, truth = time.monotonic_ns(), airborne.truth
    here = perception.capture(stamp_ns)
    assert here is not None
    camera = CameraProcess(SCENE, rate_hz=30.0, shared_name=segment)
    camera.start()
    try:
        camera.send_pose(truth.position_ned_m, truth.quaternion, stamp_ns, airborne.vehicle.faults.now_s)
        there = first_frame(segment)
    finally:
        camera.stop()
    assert there.captured_ns == stamp_ns
    assert np.array_equal(there.image, here.frame.image)
    assert there.depth_m is not None
    assert here.frame.depth_m is not None
    assert np.array_equal(there.depth_m, here.frame.depth_m, equal_nan=True)


async def test_result_is_the_worker_s_result(airborne: LockstepVehicle, segment: str) -> None:
    """Of the same frame with depth and the same attitude, from the worker's own process."""
    settings = settings_of(
        source__uri=f"shm://{segment}",
        source__read_timeout_s="60",
        guidance__obstacles="auto",
        # A worker measures which precision is faster, and a busy computer decides otherwise.
        detector__precision="float32",
    )
    perception = RenderedPerception(settings, airborne, SCENE)
    stamp_ns, truth = time.monotonic_ns(), airborne.truth
    captured = perception.capture(stamp_ns)
    assert captured is not None
    perception.add_attitude(stamp_ns, truth.quaternion, truth.height_m)
    here = perception.process(captured.frame, stamp_ns)
    assert here is not None
    model = perception.scene.camera.model
    with SharedFrameWriter(segment, model.width, model.height, depth=True) as writer:
        writer.write(captured.frame)
        worker = await PerceptionProcess.spawn(settings, subprocess.DEVNULL)
        worker.send_attitude(Attitude(stamp_ns, truth.quaternion, truth.height_m))
        there = None
        while there is None and (message := await worker.read()) is not None:
            if isinstance(message, Report):
                there = message.result
        worker.kill()
        await worker.wait()
    assert there is not None
    assert rows(there) == rows(here)
    assert len(here.detections) > 0
    assert np.isfinite(here.detections.depth_m).any()
    assert here.obstacles is not None
    assert there.obstacles is not None
    np.testing.assert_array_equal(there.obstacles.distance_m, here.obstacles.distance_m)
    assert np.isfinite(here.obstacles.distance_m).any()


def test_markers_are_found_where_they_are() -> None:
    scene = scene_or_demo("marker_landing", 0)
    vehicle = LockstepVehicle(seed=SEED, scene=scene)
    vehicle.take_off(6.0)
    settings = settings_of(
        camera__horizontal_fov_deg="78",
        camera__mount_pitch_deg="-60",
        detector__enabled="false",
        markers__dictionary="APRILTAG_36h11",
        markers__size_m="0.8",
    )
    perception = RenderedPerception(settings, vehicle)
    assert perception.scene is scene
    now_ns = round(vehicle.now_s * 1e9)
    add_attitude(perception, vehicle, now_ns)
    result = perception.look(now_ns)
    assert result is not None
    assert result.markers is not None
    (marker,) = result.markers
    assert marker.identifier == 4
    range_m = math.dist(vehicle.truth.position_ned_m, (6.0, 2.0, 0.0))
    assert float(np.linalg.norm(marker.position_camera_m)) == pytest.approx(range_m, rel=0.03)
    assert perception.class_names == ()


def test_without_a_scene_it_is_refused(airborne: LockstepVehicle) -> None:
    with pytest.raises(ValueError, match="scene"):
        RenderedPerception(settings_of(), airborne)


def first_frame(name: str) -> Frame:
    deadline_s = time.monotonic() + DEADLINE_S
    while not segment_path(name).exists():
        assert time.monotonic() < deadline_s, "no shared memory"
        time.sleep(0.01)
    with SharedFrameReader(name) as reader:
        while (frame := reader.latest()) is None:
            assert time.monotonic() < deadline_s, "no frame"
            time.sleep(0.01)
        return frame
