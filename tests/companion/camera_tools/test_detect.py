"""`companion detect` of boxes: tracks, lines, images."""

import json
import os
import shutil
import time
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.camera_tools.detect import Boxes, Output, Summary, detect_source, make_save_folder
from companion.perception.assembly import CameraTelemetry
from companion.settings.reading import load_settings
from vision.annotate import annotate
from vision.detections import Detections
from vision.object_detector import Timing
from vision.sources import open_source

pytestmark = pytest.mark.realtime

RATE_HZ = 5.0
SHOWN = 20


class WhiteBlobDetector:
    """Detects white areas."""

    class_names = ("blob",)
    last_timing = Timing(0.0, 0.0, 0.0)

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        white = (image_bgr[:, :, 0] > 128).astype(np.uint8)
        count, _, found, _ = cv2.connectedComponentsWithStats(white)
        boxes = np.array([(x, y, x + w, y + h) for x, y, w, h, _ in found[1:]], np.float32).reshape(-1, 4)
        ones = np.ones(count - 1, np.float32)
        return Detections(boxes, 0.9 * ones, np.zeros(count - 1, np.int64), self.class_names)


@pytest.fixture
def two_squares(tmp_path: Path) -> Path:
    """One square moves right, one down out of the image; another appears 3 s later, after `max_age_s`."""
    path = tmp_path / "squares.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE_HZ, (160, 120))
    for index in range(SHOWN + 16):
        image = np.zeros((120, 160, 3), np.uint8)
        if index < SHOWN:
            image[10:30, 4 + 3 * index : 24 + 3 * index] = 255
            image[50 + 2 * index : 70 + 2 * index, 120:140] = 255
        elif index == SHOWN + 15:
            image[10:30, 4 + 3 * SHOWN : 24 + 3 * SHOWN] = 255
        video.write(image)
    video.release()
    return path


def detected(path: Path, lines: list[str] | None = None, *, track: bool = False, **output: Any) -> Summary:
    """Detect white areas in a source; `lines` are printed."""
    settings = load_settings(os.devnull, {"tracker.enabled": str(track).lower()}, {})
    where = Output(write=(list[str]() if lines is None else lines).append, **output)
    with open_source(str(path)) as source:
        parts = [Boxes(tracked=track, ranged=False)]
        detector = cast(Any, WhiteBlobDetector())
        return detect_source(source, settings, detector, parts, where, CameraTelemetry())


def tracks_of(path: Path) -> list[list[dict[str, Any]]]:
    lines: list[str] = []
    detected(path, lines, track=True, as_json=True)
    return [json.loads(line)["detections"] for line in lines]


def test_objects_keep_ids_and_a_later_one_gets_a_new_id(two_squares: Path) -> None:
    started_s = time.monotonic()
    frames = tracks_of(two_squares)
    read_in_s = time.monotonic() - started_s
    by_side = [
        {record["center"][0] > 118: record["track_id"] for record in found} for found in frames[:SHOWN]
    ]
    assert by_side == [{False: 1, True: 2}] * SHOWN or by_side == [{False: 2, True: 1}] * SHOWN
    assert [record["track_state"] for record in frames[SHOWN - 1]] == ["confirmed", "confirmed"]
    # It is absent for 3 s of the recording's time, however fast the recording is read.
    assert [record["track_id"] for record in frames[-1]] == [3], f"read in {read_in_s:.1f} s"


def test_text_lines_show_id_and_confirmation(two_squares: Path) -> None:
    lines: list[str] = []
    detected(two_squares, lines, track=True, limit=6)
    assert "blob 0.90 #1?, blob 0.90 #2?" in lines[0]
    assert "blob 0.90 #1, blob 0.90 #2" in lines[-1] or "blob 0.90 #2, blob 0.90 #1" in lines[-1]


def test_without_tracker_there_are_no_track_fields(two_squares: Path) -> None:
    lines: list[str] = []
    detected(two_squares, lines, limit=2, as_json=True)
    records = [record for line in lines for record in json.loads(line)["detections"]]
    assert len(records) == 4
    assert not any(key.startswith("track_") for record in records for key in record)


def test_lines_name_the_video_and_its_time(two_squares: Path) -> None:
    text: list[str] = []
    lines: list[str] = []
    for as_json, written in ((False, text), (True, lines)):
        detected(two_squares, written, limit=3, as_json=as_json)
    assert [line.split()[:2] for line in text] == [
        ["squares.avi", time] for time in ("0.000", "0.200", "0.400")
    ]
    messages = [json.loads(line) for line in lines]
    assert [(message["file"], message["media_s"]) for message in messages] == [
        ("squares.avi", 0.0), ("squares.avi", 0.2), ("squares.avi", 0.4),
    ]  # fmt: skip


def test_summary_counts_frames_and_objects(two_squares: Path) -> None:
    summary = detected(two_squares, limit=5)
    assert summary.frames == 5
    assert summary.objects == {"blob": 10}
    assert str(summary).startswith("5 frames, ")
    assert str(summary).endswith(": 10 blob")


def test_saved_images_keep_their_names(two_squares: Path, tmp_path: Path) -> None:
    photos, saved = tmp_path / "photos", tmp_path / "saved"
    photos.mkdir()
    for name in ("boat.png", "boat.jpg"):
        cv2.imwrite(str(photos / name), np.full((60, 80, 3), 255, np.uint8))
    make_save_folder(saved, str(photos))
    lines: list[str] = []
    for path, limit in ((photos, None), (two_squares, 1)):
        detected(path, lines, limit=limit, save=saved)
    names = ["boat.jpg", "boat.png", "squares_000000.jpg"]
    assert sorted(path.name for path in saved.iterdir() if path.is_file()) == names
    assert sorted(path.name for path in (saved / "detections").iterdir()) == names
    assert [line.split()[0] for line in lines] == ["boat.jpg", "boat.png", "squares.avi"]


def test_names_that_are_not_utf8_or_have_line_ends_are_escaped_and_saved(tmp_path: Path) -> None:
    photos, saved = tmp_path / "photos", tmp_path / "saved"
    photos.mkdir()
    names = [os.fsdecode(b"caf\xe9.png"), "two\nlines.png"]
    image = cv2.imencode(".png", np.full((60, 80, 3), 255, np.uint8))[1].tobytes()
    for name in names:
        (photos / name).write_bytes(image)
    make_save_folder(saved, str(photos))
    lines: list[str] = []
    detected(photos, lines, save=saved)
    assert [line.split()[0] for line in lines] == [r"caf\udce9.png", r"two\nlines.png"]
    assert sorted(path.name for path in (saved / "detections").iterdir()) == names


def test_image_that_cannot_be_written_is_named(two_squares: Path, tmp_path: Path) -> None:
    make_save_folder(tmp_path / "saved", str(two_squares))
    shutil.rmtree(tmp_path / "saved")
    with pytest.raises(OSError, match=f"cannot write {tmp_path}/saved/"):
        detected(two_squares, save=tmp_path / "saved")


def test_save_folder_of_the_source_or_that_is_a_file_is_refused(two_squares: Path) -> None:
    for source in (two_squares, two_squares.parent):
        with pytest.raises(ValueError, match=rf"--save {two_squares.parent}: .*source"):
            make_save_folder(two_squares.parent, str(source))
    with pytest.raises(ValueError, match="expected a folder"):
        make_save_folder(two_squares, "photos")


def test_detections_below_service_confidence_are_drawn_fainter() -> None:
    image = np.zeros((120, 160, 3), np.uint8)
    boxes = np.array([(10, 40, 60, 100), (90, 40, 150, 100)], np.float32)
    found = Detections(boxes, np.array([0.9, 0.3], np.float32), np.zeros(2, np.int64), ("blob",))
    drawn = annotate(image, found, faint_below=0.4)
    left, right = (int(drawn[45:95, x].max()) for x in (10, 90))
    assert right == pytest.approx(left / 2, abs=2)
