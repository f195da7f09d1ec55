"""Official AprilTag prints and OpenCV's, from the image to what is sent to the autopilot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.rendered import camera_settings
from companion.guidance.objects.from_detections import StateHistory
from companion.guidance.objects.from_markers import LocalizedMarkers
from companion.perception.assembly import marker_finder
from companion.perception.cameras import PerceptionCamera
from companion.perception.map_position import DRIFT_MPS, ESTIMATE_MARGIN_M, VisionGate
from companion.perception.marker_tracker import MarkerTracker
from companion.settings.reading import ConfigurationError, load_settings
from companion.vehicle.state import Vector3, VehicleState, with_fields
from companion.vehicle.vision_position import VisionPosition
from vision.attitude import quaternion_from_euler
from vision.camera_model import CameraModel, CameraMount
from vision.detections import Detections
from vision.frame import Frame
from vision.marker_boards import ned_from_marker
from vision.markers import MarkerKind, marker_modules, square
from vision.pipeline import PerceptionResult

CAMERA = CameraModel.from_horizontal_fov(640, 480, 1.2)
DICTIONARY, SIZE_M = "APRILTAG_36h11", 0.5
EYE = (-1.0, 0.0, -3.0)
PRINTS = ("opencv", "apriltag")
OTHER = dict(zip(PRINTS, reversed(PRINTS), strict=True))
# Id → north, east, down, yaw, standing.
Places = Mapping[int, tuple[float, float, float, float, bool]]
LYING: Places = {3: (0.0, 0.0, 0.0, 0.4, False)}
MAT: Places = {3: (0.0, 0.0, 0.0, 0.4, False), 4: (-1.2, 0.7, 0.0, -1.1, False)}
WALL: Places = {3: (0.6, 0.5, -2.8, math.pi, True)}


def map_file(folder: Path, places: Places, head: str = "") -> Path:
    file = folder / "map.toml"
    file.write_text(
        head
        + "".join(
            f"[[markers]]\nid = {identifier}\nsize_m = {SIZE_M}\nposition_m = [{north}, {east}, {down}]\n"
            f"yaw_deg = {math.degrees(yaw)}\nstanding = {str(standing).lower()}\n"
            for identifier, (north, east, down, yaw, standing) in places.items()
        )
    )
    return file


class View:
    """A level vehicle at `EYE` that heads north, before prints that were laid by their upper edge."""

    def __init__(self, places: Places, printed: str, settings: Mapping[str, str], pitch_deg: float) -> None:
        mount = CameraMount(pitch_rad=math.radians(pitch_deg))
        values = {
            "detector.enabled": "false",
            "markers.dictionary": DICTIONARY,
            "markers.size_m": str(SIZE_M),
            **settings,
        }
        self.settings = camera_settings(CAMERA, mount, values)
        self.events: list[tuple[str, str]] = []
        camera = PerceptionCamera(self.settings)
        self.camera = camera
        self.tracker = MarkerTracker([camera], lambda *event: self.events.append(event))
        find = marker_finder(self.settings)
        assert find is not None
        self.find = find
        self.state = VehicleState(
            attitude=(1.0, 0.0, 0.0, 0.0), position_ned_m=EYE, home_position_ned_m=(0.0, 0.0, 0.0),
            position_valid=True, horizontal_sigma_m=0.1,
        )  # fmt: skip
        self.image = np.asarray(cv2.cvtColor(rendered(places, printed, mount), cv2.COLOR_GRAY2BGR), np.uint8)
        self.now_ns = 10**9

    def frame(self) -> LocalizedMarkers:
        self.now_ns += 10**8
        state = with_fields(self.state, attitude_ns=self.now_ns, position_ns=self.now_ns)
        history = StateHistory()
        history.add(state)
        markers, boards = self.find(Frame(self.image, self.now_ns, 0))
        result = PerceptionResult(
            sequence=0, captured_ns=self.now_ns, inferred_ns=self.now_ns, timing_ms={}, dropped=0,
            width=CAMERA.width, height=CAMERA.height,
            detections=Detections.empty(()), markers=markers, boards=boards,
        )  # fmt: skip
        return self.tracker.localize(self.camera, result, history, state)

    def frames(self, count: int = 12) -> list[LocalizedMarkers]:
        return [self.frame() for _ in range(count)]


def rendered(
    places: Places, printed: str, mount: CameraMount
) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    ned_from_optical = mount.ned_from_optical(np.eye(3))
    eye = np.array(EYE) + mount.position_frd_m
    image = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    for identifier, (north, east, down, yaw, standing) in places.items():
        black = marker_modules(MarkerKind(DICTIONARY, SIZE_M, print=printed), identifier)
        patch = np.kron(np.where(black, 0, 255), np.ones((40, 40))).astype(np.uint8)
        corners = square(SIZE_M) @ ned_from_marker(yaw, standing).T + (north, east, down)
        pixels = CAMERA.project((corners - eye) @ ned_from_optical).astype(np.float32)
        side = float(len(patch))
        source = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
        homography = cv2.getPerspectiveTransform(source - np.float32(0.5), pixels)
        size = (CAMERA.width, CAMERA.height)
        drawn = cv2.warpPerspective(patch, homography, size, flags=cv2.INTER_AREA, borderValue=(255,))
        image = np.minimum(image, drawn).astype(np.uint8)
    return image


def view(
    folder: Path, places: Places, printed: str, setting: str, *, pitch_deg: float = -90.0, head: str = ""
) -> View:
    settings = {
        "markers.print": setting,
        "markers.map_file": str(map_file(folder, places, head)),
        "markers.localise": "true",
    }
    return View(places, printed, settings, pitch_deg)


@pytest.mark.parametrize("places", [LYING, MAT, WALL], ids=["lying", "two", "wall"])
@pytest.mark.parametrize("printed", PRINTS)
def test_map_of_either_print_gives_the_true_position(tmp_path: Path, printed: str, places: Places) -> None:
    pitch_deg = 0.0 if places is WALL else -90.0
    sent = [
        each.vision
        for each in view(tmp_path, places, printed, printed, pitch_deg=pitch_deg).frames(4)
        if each.vision is not None
    ]
    assert len(sent) >= 2
    for vision in sent:
        assert vision.position_ned_m == pytest.approx(EYE, abs=0.05)
        assert vision.euler_rad[2] == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("places", [LYING, MAT, WALL], ids=["lying", "two", "wall"])
@pytest.mark.parametrize("printed", PRINTS)
def test_wrong_print_is_never_sent_and_names_the_setting(
    tmp_path: Path, printed: str, places: Places
) -> None:
    pitch_deg = 0.0 if places is WALL else -90.0
    wrong = view(tmp_path, places, printed, OTHER[printed], pitch_deg=pitch_deg)
    assert [each.vision for each in wrong.frames(30)] == [None] * 30
    assert 2 <= len(wrong.events) <= 4
    for level, text in wrong.events:
        assert level == "warning"
        assert f'markers.print = "{printed}"' in text
    # All of them are counted: one marker from its third frame on.
    assert wrong.tracker.vision_dropped == 28


@pytest.mark.parametrize("printed", PRINTS)
def test_print_of_a_map_file_goes_before_the_setting(tmp_path: Path, printed: str) -> None:
    both = view(tmp_path, LYING, printed, OTHER[printed], head=f'print = "{printed}"\n')
    assert both.frames(4)[-1].vision is not None
    assert not both.events


@pytest.mark.parametrize("printed", PRINTS)
def test_heading_and_pad_offset_follow_the_print(tmp_path: Path, printed: str) -> None:
    """The pad's centre is 0.3 m to the print's right and 0.2 m above it."""
    settings = {"markers.print": printed, "markers.others": f"3:{SIZE_M}@7:-0.3:-0.2"}
    for target in View(LYING, printed, settings, -90.0).frame().targets:
        assert target.heading_rad == pytest.approx(0.4, abs=0.03)
        north = 0.2 * math.cos(0.4) - 0.3 * math.sin(0.4)
        east = 0.2 * math.sin(0.4) + 0.3 * math.cos(0.4)
        assert target.pad_ned_m == pytest.approx((north, east, 0.0), abs=0.05)


@pytest.mark.parametrize("printed", PRINTS)
@pytest.mark.parametrize("setting", PRINTS)
def test_markers_of_a_pad_that_disagree_name_the_print(printed: str, setting: str) -> None:
    """A large marker 0.9 m to the small one's right, both printed the same way up."""
    places: Places = {3: (0.0, 0.0, 0.0, 0.0, False), 4: (0.0, 0.9, 0.0, 0.0, False)}
    settings = {"markers.print": setting, "markers.others": f"4:{SIZE_M}@3:0.9:0"}
    pad = View(places, printed, settings, -90.0)
    pad.frames(25)
    if setting == printed:
        assert pad.events == []
    else:
        assert len(pad.events) in (2, 3)
        assert f'markers.print = "{printed}"' in pad.events[0][1]
        assert "1.8 m" in pad.events[0][1]


@pytest.mark.parametrize("printed", PRINTS)
def test_boards_of_either_print_have_their_axes(tmp_path: Path, printed: str) -> None:
    file = tmp_path / "dock.toml"
    file.write_text(
        f'[[boards]]\nname = "dock"\nprint = "{printed}"\n'
        f"[[boards.markers]]\nid = 3\nsize_m = {SIZE_M}\nposition_m = [0, 0, 0]\n"
    )
    settings = {"markers.boards_file": str(file), "markers.print": OTHER[printed]}
    (board,) = View(LYING, printed, settings, -90.0).frame().boards
    assert board.position_ned_m == pytest.approx((0.0, 0.0, 0.0), abs=0.05)
    w, x, y, z = board.body.rotation
    # The board's upper edge, in the body frame of a vehicle that heads north.
    upper = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z)
    assert math.atan2(upper[1], upper[0]) == pytest.approx(0.4, abs=0.05)


def test_boards_that_disagree_about_a_print_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "two.toml"
    board = (
        '[[boards]]\nname = "{0}"\nprint = "{1}"\n'
        "[[boards.markers]]\nid = 3\nsize_m = 0.5\nposition_m = [0, 0, 0]\n"
    )
    file.write_text(board.format("one", "opencv") + board.format("two", "apriltag"))
    with pytest.raises(ConfigurationError, match=r"3 .*'opencv'.*'apriltag' .*'two'"):
        load_settings(None, {"markers.dictionary": DICTIONARY, "markers.boards_file": str(file)})


def vision_at(seconds: float, north: float, yaw: float = 0.0, sigma_m: float = 0.0) -> VisionPosition:
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = np.eye(2) * sigma_m**2 / 2.0
    upper = tuple(covariance[np.triu_indices(6)].tolist())
    return VisionPosition(round(seconds * 1e9), (north, 0.0, -3.0), (0.0, 0.0, yaw), upper)


def agrees(
    gate: VisionGate, vision: VisionPosition, yaw: float = 0.0, offset: Vector3 = (0.0, 0.0, 0.0)
) -> bool:
    """Against an estimate at the origin with a sigma of 1e-9 m."""
    history = StateHistory()
    history.add(
        VehicleState(
            attitude_ns=vision.captured_ns, position_ns=vision.captured_ns,
            attitude=quaternion_from_euler(0.0, 0.0, yaw), position_ned_m=(0.0, 0.0, 0.0),
            home_position_ned_m=(0.0, 0.0, 0.0), horizontal_sigma_m=1e-9,
        )
    )  # fmt: skip
    return gate.contradiction(vision, history.at(vision.captured_ns), offset) is None


def test_bound_grows_with_sigma_and_with_time() -> None:
    gate = VisionGate()
    assert gate.check(vision_at(1.0, 0.0)) is None
    for seconds, sigma_m, allowed_m in (
        (1.0, 0.0, ESTIMATE_MARGIN_M),
        (1.0, 1.0, ESTIMATE_MARGIN_M + 3.0),
        (11.0, 0.0, ESTIMATE_MARGIN_M + 10.0 * DRIFT_MPS),
        (1000.0, 0.0, ESTIMATE_MARGIN_M + 10.0),
    ):
        assert agrees(gate, vision_at(seconds, allowed_m - 0.01, sigma_m=sigma_m))
        assert not agrees(gate, vision_at(seconds, allowed_m + 0.01, sigma_m=sigma_m))
    # Resets of the estimate are of its own frame, in which positions are sent.
    assert agrees(gate, vision_at(1.0, 40.0), offset=(40.0, 0.0, 0.0))
    assert gate.dropped == 4


@pytest.mark.parametrize("yaw_deg", [0.0, 170.0, -100.0])
def test_heading_may_differ_by_60_degrees(yaw_deg: float) -> None:
    gate, yaw = VisionGate(), math.radians(yaw_deg)
    for off_deg, agreed in ((0.0, True), (59.0, True), (-59.0, True), (61.0, False), (180.0, False)):
        vision = vision_at(1.0, 0.0, yaw + math.radians(off_deg))
        assert agrees(gate, vision, yaw) is agreed


def test_an_invalid_estimate_drops_nothing(tmp_path: Path) -> None:
    """Without GNSS the map is the only position: the estimate is anywhere."""
    lost = view(tmp_path, LYING, "opencv", "opencv")
    lost.state = with_fields(lost.state, position_ned_m=(50.0, 20.0, -3.0), position_valid=False)
    assert lost.frames(4)[-1].vision is not None
    lost.state = with_fields(lost.state, position_valid=True)
    assert lost.frame().vision is None
    assert "estimate" in lost.events[-1][1]
    assert "markers.print" not in lost.events[-1][1]
