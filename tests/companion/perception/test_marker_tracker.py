"""Which markers are confirmed, and which positions from a map are sent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.rendered import camera_settings
from companion.guidance.behaviour import BehaviourContext
from companion.guidance.behaviours.land_on_marker import LandOnMarkerBehaviour
from companion.guidance.objects.from_detections import StateHistory
from companion.guidance.objects.from_markers import LocalizedMarkers
from companion.guidance.requirements import check_requirements
from companion.perception.cameras import PerceptionCamera
from companion.perception.map_position import VisionGate
from companion.perception.marker_tracker import MarkerTracker
from companion.vehicle.state import VehicleState
from companion.vehicle.vision_position import VisionPosition
from vision.camera_model import CameraModel, CameraMount
from vision.detections import Detections
from vision.marker_boards import MAP, locate_board, ned_from_marker
from vision.markers import Marker, marker_from_corners, square
from vision.pipeline import PerceptionResult

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
SIZE_M = 0.4
# North, east of the markers of the map.
MAP_PLACES = {1: (0.0, 0.0), 2: (1.5, 0.0), 9: (8.0, 5.0)}
HEIGHT_M = 3.0


class Flight:
    """A level vehicle that heads north, with a camera (downward, unless given) above markers."""

    def __init__(self, tmp_path: Path, pitch_deg: float = -90.0) -> None:
        file = tmp_path / "map.toml"
        file.write_text(
            "".join(
                f"[[markers]]\nid = {identifier}\nsize_m = {SIZE_M}\n"
                f"position_m = [{north}, {east}, 0]\nyaw_deg = 0\n"
                for identifier, (north, east) in MAP_PLACES.items()
            )
        )
        settings = camera_settings(
            CAMERA,
            CameraMount(pitch_rad=math.radians(pitch_deg)),
            {
                "markers.dictionary": "APRILTAG_36h11",
                "markers.size_m": str(SIZE_M),
                "markers.map_file": str(file),
                "markers.localise": "true",
            },
        )
        self.camera = PerceptionCamera(settings)
        self.board = next(board for board in settings.markers.boards() if board.name == MAP)
        self.events: list[tuple[str, str]] = []
        self.tracker = MarkerTracker([self.camera], lambda *event: self.events.append(event))
        self.now_ns = 10**9

    def frame(
        self,
        seen: Sequence[tuple[int, tuple[float, float]]],
        *,
        north: float = 0.0,
        later_s: float = 0.1,
        known: bool = True,
    ) -> LocalizedMarkers:
        """Process a frame with these (id, (north, east)) in it, the vehicle at `north`."""
        self.now_ns += round(later_s * 1e9)
        state = VehicleState(
            attitude_ns=self.now_ns, position_ns=self.now_ns, attitude=(1.0, 0.0, 0.0, 0.0),
            position_ned_m=(north, 0.0, -HEIGHT_M), home_position_ned_m=(0.0, 0.0, 0.0),
        )  # fmt: skip
        history = StateHistory()
        if known:
            history.add(state)
        mount = self.camera.settings.camera.mount()
        markers = tuple(self._marker(identifier, place, north, mount) for identifier, place in seen)
        located = locate_board(self.board, markers, CAMERA)
        result = PerceptionResult(
            sequence=0, captured_ns=self.now_ns, inferred_ns=self.now_ns, timing_ms={}, dropped=0,
            width=CAMERA.width, height=CAMERA.height,
            detections=Detections.empty(()), markers=markers, boards=() if located is None else (located,),
        )  # fmt: skip
        return self.tracker.localize(self.camera, result, history, state)

    def _marker(
        self, identifier: int, place: tuple[float, float], north: float, mount: CameraMount
    ) -> Marker:
        ned_from_optical = mount.ned_from_optical(np.eye(3))
        corners = square(SIZE_M) @ ned_from_marker(0.0, False).T + (*place, 0.0)
        eye = np.array([north, 0.0, -HEIGHT_M]) + mount.position_frd_m
        marker = marker_from_corners(
            identifier, CAMERA.project((corners - eye) @ ned_from_optical), SIZE_M, CAMERA
        )
        assert marker is not None
        return marker

    def confirmed(self, *seen: tuple[int, tuple[float, float]], **frame: Any) -> list[bool]:
        return [target.confirmed for target in self.frame(seen, **frame).targets]


@pytest.fixture
def flight(tmp_path: Path) -> Flight:
    return Flight(tmp_path)


def test_marker_is_confirmed_after_three_frames_in_a_row(flight: Flight) -> None:
    marker = (5, (0.3, 0.2))
    assert [flight.confirmed(marker) for _ in range(4)] == [[False], [False], [True], [True]]
    # One frame without it begins again, however short.
    flight.confirmed(later_s=0.03)
    assert [flight.confirmed(marker, later_s=0.03) for _ in range(3)] == [[False], [False], [True]]
    # So does a gap between frames, and a frame whose pose is unknown.
    assert flight.confirmed(marker, later_s=0.6) == [False]
    assert [flight.confirmed(marker) for _ in range(2)] == [[False], [True]]
    assert flight.frame([marker], known=False).error
    assert flight.confirmed(marker) == [False]


def test_marker_in_every_second_frame_is_never_confirmed(flight: Flight) -> None:
    for _ in range(10):
        assert flight.confirmed((5, (0.3, 0.2)), later_s=0.03) == [False]
        flight.confirmed((6, (0.3, 0.2)), later_s=0.03)


def test_marker_seen_twice_in_a_frame_is_refused(flight: Flight) -> None:
    one, other = (5, (0.3, 0.2)), (5, (-0.6, 0.2))
    for _ in range(5):
        assert flight.confirmed(one, other) == [False, False]
    assert flight.tracker.sight(flight.now_ns, 0.5).targets == ()
    assert [flight.confirmed(one) for _ in range(3)] == [[False], [False], [True]]
    assert [target.identifier for target in flight.tracker.sight(flight.now_ns, 0.5).targets] == [5]


def test_missed_frames_do_not_put_an_object_in_doubt(flight: Flight) -> None:
    for step in range(30):
        flight.frame([] if step > 3 and step % 2 else [(5, (0.3, 0.2))], later_s=0.05)
    [marker] = flight.tracker.objects(flight.camera)
    assert marker.certain
    assert marker.doubt == 0.0
    # Elsewhere, it is not taken.
    flight.frame([(5, (-1.0, -0.2))], later_s=0.05)
    [same] = flight.tracker.objects(flight.camera)
    assert same.occluded
    assert same.position_ned_m == marker.position_ned_m


def test_marker_elsewhere_after_a_gap_is_it_when_confirmed(flight: Flight) -> None:
    """A single false detection is not."""
    for _ in range(10):
        flight.frame([(5, (0.3, 0.0))], later_s=0.05)
    for later_s in (0.7, 0.05):
        flight.frame([(5, (-1.8, 1.0))], later_s=later_s)
        for below in (flight.tracker.objects_below(), flight.tracker.objects(flight.camera)):
            assert [each.position_ned_m for each in below] == [pytest.approx((0.3, 0.0, 0.0), abs=0.02)]
    flight.frame([(5, (-1.8, 1.0))], later_s=0.05)
    [moved] = flight.tracker.objects_below()
    assert moved.position_ned_m == pytest.approx((-1.8, 1.0, 0.0), abs=0.02)


def test_of_two_cameras_below_the_newest_object_is_used(tmp_path: Path) -> None:
    flight, other = Flight(tmp_path), PerceptionCamera(Flight(tmp_path).camera.settings, "other")
    forward = PerceptionCamera(Flight(tmp_path, 0.0).camera.settings, "forward")
    first = flight.camera
    flight.tracker = MarkerTracker([first, other, forward], lambda *event: None)
    flight.frame([(5, (0.3, 0.2)), (6, (0.0, 0.0))])
    flight.camera = other
    flight.frame([(6, (0.4, 0.0))])
    flight.camera = forward
    flight.frame([(9, (6.0, 0.0))])
    assert flight.tracker.objects(forward)
    below = {each.class_name: each for each in flight.tracker.objects_below()}
    assert set(below) == {"marker 5", "marker 6"}
    assert below["marker 5"] in flight.tracker.objects(first)
    assert below["marker 6"] in flight.tracker.objects(other)


@pytest.mark.parametrize("frozen", ["forward", "down"])
def test_fault_below_is_that_of_a_camera_that_looks_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frozen: str
) -> None:
    flight, forward = Flight(tmp_path), PerceptionCamera(Flight(tmp_path, 0.0).camera.settings, "forward")
    down = flight.camera
    flight.tracker = MarkerTracker([down, forward], lambda *event: None)
    for camera in (forward, down):
        flight.camera = camera
        flight.frame([])
    monkeypatch.setattr({"forward": forward, "down": down}[frozen], "frozen", lambda now_ns: "frozen")
    assert flight.tracker.sight(flight.now_ns, 0.5).fault == ("frozen" if frozen == "down" else "")
    assert flight.tracker.steering_sight(forward, flight.now_ns, 0.5).fault == (
        "frozen" if frozen == "forward" else ""
    )


def test_landing_on_a_marker_needs_a_camera_down(tmp_path: Path) -> None:
    def refused(pitch_deg: float) -> str:
        flight = Flight(tmp_path, pitch_deg)
        flight.frame([])
        state = VehicleState(heartbeat_ns=flight.now_ns)
        context = BehaviourContext(flight.now_ns, state, markers=flight.tracker.sight(flight.now_ns, 0.5))
        return check_requirements(LandOnMarkerBehaviour(7), context, None) or ""

    assert "pitch_deg is -20" in refused(-20.0)
    assert "mount_pitch_deg" not in refused(-90.0)


def test_marker_that_jumps_in_ned_is_not_confirmed(flight: Flight) -> None:
    for frame in range(8):
        assert flight.confirmed((5, (0.0, 0.8 if frame % 2 else -0.8))) == [False]
    # The vehicle's own motion is no jump.
    norths = (-0.9, 0.3, -0.9)
    assert [flight.confirmed((6, (0.0, 0.0)), north=north) for north in norths] == [[False], [False], [True]]


def test_position_needs_two_markers_or_a_confirmed_one(flight: Flight) -> None:
    both = [(1, MAP_PLACES[1]), (2, MAP_PLACES[2])]
    vision = flight.frame(both, north=0.5).vision
    assert vision is not None
    assert vision.position_ned_m == pytest.approx((0.5, 0.0, -HEIGHT_M), abs=0.01)
    # A frame without any begins again.
    assert flight.frame([]).vision is None
    sent = [flight.frame(both[:1]).vision is not None for _ in range(4)]
    assert sent == [False, False, True, True]


def test_false_marker_is_not_sent_and_reported_once_a_second(flight: Flight) -> None:
    """Marker 1 read as 9, which the map has 9.4 m away."""
    for _ in range(5):
        flight.frame([(1, MAP_PLACES[1])])
    assert flight.frame([(9, MAP_PLACES[1])]).vision is None
    assert not flight.events
    # Confirmed, but out of reach; true ones between them keep it out however long that lasts.
    for _ in range(12):
        for _ in range(4):
            assert flight.frame([(9, MAP_PLACES[1])]).vision is None
        both = [(1, MAP_PLACES[1]), (2, MAP_PLACES[2])]
        assert flight.frame(both).vision is not None
    assert 4 <= len(flight.events) <= 6
    level, text = flight.events[-1]
    assert level == "warning"
    assert "9.4 m" in text
    assert "dropped" in text


def vision_at(seconds: float, north: float, sigma_m: float = 0.04) -> VisionPosition:
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.eye(3) * sigma_m**2
    upper = tuple(covariance[np.triu_indices(6)].tolist())
    return VisionPosition(round(seconds * 1e9), (north, 0.0, -3.0), (0.0, 0.0, 0.0), upper)


def test_jump_is_accepted_once_it_has_agreed_for_a_second() -> None:
    gate = VisionGate()
    assert gate.check(vision_at(1.0, 0.0)) is None
    sent = [gate.check(vision_at(1.1 + 0.1 * step, 40.0)) for step in range(11)]
    assert sent[:10] == [pytest.approx(40.0)] * 10
    assert sent[10] is None
    assert gate.dropped == 10
    assert gate.check(vision_at(2.2, 40.1)) is None


def test_jumps_that_do_not_agree_are_never_accepted() -> None:
    gate = VisionGate()
    assert gate.check(vision_at(1.0, 0.0)) is None
    for step in range(20):
        # To two places in turn.
        assert gate.check(vision_at(1.05 + 0.05 * step, 100.0 + 30.0 * (step % 2))) is not None
    gate = VisionGate()
    assert gate.check(vision_at(1.0, 0.0)) is None
    for step in range(4):
        # With gaps.
        assert gate.check(vision_at(1.6 + 0.6 * step, 100.0)) is not None


def test_uncertain_positions_may_differ_by_three_sigma() -> None:
    for sigma_m, dropped in ((0.5, False), (0.1, True)):
        gate = VisionGate()
        assert gate.check(vision_at(1.0, 0.0, sigma_m)) is None
        assert (gate.check(vision_at(1.1, 3.3, sigma_m)) is not None) is dropped
