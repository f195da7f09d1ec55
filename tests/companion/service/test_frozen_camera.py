"""In flight an image that was seen before is no new frame; on the ground it may well be."""

from __future__ import annotations

import numpy as np
import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.guidance.interface import GuidanceInput, StreamStatus
from companion.perception.cameras import PerceptionCamera
from companion.service.inputs import InputAssembler
from companion.settings import DetectorSection, Settings
from companion.vehicle.state import LandedState, VehicleState
from companion.vehicle.streamer import StreamState
from vision.detections import Detections
from vision.obstacle_sectors import SECTORS, ObstacleSectors
from vision.pipeline import PerceptionResult

PERIOD_NS = 20_000_000
START_NS = 10**12
IN_FLIGHT, PARKED = (True, LandedState.IN_AIR), (False, LandedState.ON_GROUND)


class Bench:
    """One camera that shows images by number, 50 a second, above a vehicle that stands still."""

    def __init__(self, armed: bool, landed: LandedState) -> None:
        self.events: list[tuple[str, str]] = []
        self.camera = PerceptionCamera(plain_settings({"guidance.perception_max_age_s": "0.5"}))
        self.inputs = InputAssembler(
            self.camera.settings, [self.camera], lambda level, text: self.events.append((level, text))
        )
        self.now_ns, self._first_ns = START_NS, dict[tuple[str, int], int]()
        self._flags = armed, landed

    def show(self, image: int, depth: int | None = None) -> GuidanceInput:
        """A frame with that image and depth image, and what guidance gets a moment later."""
        self.now_ns += PERIOD_NS
        armed, landed = self._flags
        state = VehicleState(
            heartbeat_ns=self.now_ns,
            attitude_ns=self.now_ns,
            position_ns=self.now_ns,
            attitude=(1.0, 0.0, 0.0, 0.0),
            position_ned_m=(0.0, 0.0, -5.0),
            home_position_ned_m=(0.0, 0.0, 0.0),
            armed=armed,
            landed=landed,
        )
        self.inputs.on_state(state)
        image_ns = self._first_ns.setdefault(("image", image), self.now_ns)
        depth_ns, obstacles = None, None
        if depth is not None:
            depth_ns = self._first_ns.setdefault(("depth", depth), self.now_ns)
            obstacles = ObstacleSectors(self.now_ns, (5.0,) * SECTORS)
        box = np.array([[300.0, 200.0, 340.0, 300.0]], np.float32)
        found = Detections(box, np.ones(1, np.float32), np.zeros(1, np.int64), ("person",))
        result = PerceptionResult(
            0,
            self.now_ns,
            self.now_ns,
            640,
            480,
            found,
            {},
            0,
            obstacles=obstacles,
            image_since_ns=image_ns,
            depth_since_ns=depth_ns,
        )
        self.camera.update(result)
        self.inputs.on_result(self.camera, result)
        return self.inputs.assemble(self.now_ns, state, StreamStatus(StreamState.SILENT, 0))

    def age_s(self, seen: GuidanceInput) -> float:
        assert seen.seen_ns is not None
        return (self.now_ns - seen.seen_ns) / 1e9


def test_a_frozen_camera_ages_from_the_first_image() -> None:
    bench = Bench(*IN_FLIGHT)
    bench.show(0)
    seen = [bench.show(1) for _ in range(100)]
    first_ns = START_NS + 2 * PERIOD_NS
    assert {each.seen_ns for each in seen} == {first_ns}
    assert {target.captured_ns for target in seen[20].targets} == {first_ns}
    assert not seen[20].camera_fault
    assert "camera frozen" in seen[-1].camera_fault
    assert not seen[-1].targets
    assert bench.camera.age_s(bench.now_ns) == pytest.approx(1.98)
    assert bench.camera.blind(bench.now_ns + 10**9)
    assert [level for level, _ in bench.events] == ["warning"]


def test_images_that_change_again_are_used_and_reported() -> None:
    bench = Bench(*IN_FLIGHT)
    for _ in range(60):
        bench.show(1)
    seen = bench.show(2)
    assert bench.age_s(seen) == 0.0
    assert len(seen.targets) == 1
    assert not seen.camera_fault
    assert not bench.camera.localization_error
    assert [level for level, _ in bench.events] == ["warning", "info"]


def test_an_image_at_rest_on_the_ground_is_no_fault() -> None:
    bench = Bench(*PARKED)
    seen = [bench.show(1) for _ in range(100)][-1]
    assert bench.age_s(seen) == 0.0
    assert not seen.camera_fault
    assert not bench.events


def test_an_image_from_before_the_takeoff_ages_from_there() -> None:
    bench = Bench(*PARKED)
    for _ in range(100):
        bench.show(1)
    bench._flags = IN_FLIGHT
    assert bench.age_s(bench.show(1)) == pytest.approx(0.02)


@pytest.mark.parametrize("each", [2, 3])
def test_a_video_with_doubled_frames_stays_fresh(each: int) -> None:
    bench = Bench(*IN_FLIGHT)
    seen = [bench.show(number // each) for number in range(100)]
    stamps_ns = [inputs.seen_ns or 0 for inputs in seen]
    assert max(np.diff(stamps_ns)) <= each * PERIOD_NS
    assert all(inputs.targets and not inputs.camera_fault for inputs in seen)
    assert not bench.events


def test_every_second_frame_of_doubled_ones_is_new() -> None:
    bench = Bench(*IN_FLIGHT)
    for number in range(50):
        # The first of each pair was left out by `detector.rate_hz`.
        bench._first_ns["image", number] = bench.now_ns + PERIOD_NS // 2
        assert bench.age_s(bench.show(number)) == 0.0


def test_frozen_depth_ages_targets_and_obstacles() -> None:
    bench = Bench(*IN_FLIGHT)
    seen = [bench.show(number, depth=0) for number in range(60)][-1]
    first_ns = START_NS + PERIOD_NS
    assert seen.seen_ns == first_ns
    assert seen.obstacles is not None
    assert seen.obstacles.captured_ns == first_ns
    assert "depth" in seen.camera_fault


def test_a_frozen_image_leaves_the_obstacles_of_live_depth() -> None:
    bench = Bench(*IN_FLIGHT)
    seen = [bench.show(0, depth=number) for number in range(60)][-1]
    assert bench.age_s(seen) > 1.0
    assert seen.obstacles is not None
    assert seen.obstacles.captured_ns == bench.now_ns


@pytest.mark.parametrize("detector", [True, False])
def test_a_source_whose_frames_stop_is_named(detector: bool) -> None:
    settings = Settings(detector=DetectorSection(enabled=detector))
    camera = PerceptionCamera(settings)
    what = "result" if detector else "frame"
    assert camera.blind(START_NS) == f"no {what} yet"
    for index in range(5):
        found = Detections.empty(("car",) if detector else ())
        camera.update(PerceptionResult(index, START_NS + index * PERIOD_NS, START_NS, 640, 480, found, {}, 0))
    newest_ns = START_NS + 4 * PERIOD_NS
    assert not camera.blind(newest_ns + 10**9)
    assert camera.blind(newest_ns + 10**10) == f"no {what} for 10.0 s"
