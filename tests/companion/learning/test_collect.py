"""Collecting frames to label: doubts about tracks, the data set, a recording and a running service."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh
from typer.testing import CliRunner

from companion.bench.lockstep_flight import plain_settings
from companion.bus.session import zenoh_config
from companion.bus.topics import DETECTIONS, IMAGE
from companion.cli import app
from companion.guidance.core import GuidanceOptions
from companion.learning.collect import DoubtFinder, collect, live_frames
from companion.logs.frames import DetectedFrame
from companion.recording.convert import Converter
from companion.recording.encoding import dumps
from companion.recording.tap import run_record
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.recording.lockstep_recording import new_writer
from vision.evaluation.datasets import open_dataset

MIDDLE = (40.0, 30.0, 80.0, 60.0)


def track(
    number: int | None, name: str, state: str = "confirmed", xyxy: tuple[float, ...] = MIDDLE
) -> dict[str, Any]:
    return {"track_id": number, "class_name": name, "track_state": state, "xyxy": list(xyxy)}


def message(sequence: int, *tracks: dict[str, Any]) -> dict[str, Any]:
    """Of a frame of 160x120, ten a second."""
    captured_ns = 10**9 + sequence * 10**8
    about = {"sequence": sequence, "captured_ns": captured_ns, "width": 160, "height": 120}
    return {**about, "detections": list(tracks)}


def test_sure_tracks_give_no_reason() -> None:
    finder = DoubtFinder()
    for sequence in range(3):
        assert finder.update(message(sequence, track(1, "car"), track(None, "boat", "none"))) == []


def test_doubted_lost_and_changed_tracks_are_reasons() -> None:
    finder = DoubtFinder()
    for sequence in range(4):
        assert finder.update(message(sequence, track(1, "car"), track(2, "dog", "tentative"))) == []
    assert finder.update(message(4, track(1, "car"), track(2, "dog", "tentative"))) == ["doubted dog 2"]
    assert finder.update(message(5, track(1, "truck"))) == ["changed class car 1 to truck"]
    assert finder.update(message(6)) == ["lost truck 1"]
    assert finder.update(message(7)) == []


@pytest.mark.parametrize("xyxy", [(0, 30, 40, 60), (40, 0, 80, 30), (130, 30, 159, 60), (40, 100, 60, 119)])
def test_track_that_leaves_the_image_is_not_lost(xyxy: tuple[float, ...]) -> None:
    finder = DoubtFinder()
    finder.update(message(0, track(1, "car", xyxy=xyxy)))
    assert finder.update(message(1)) == []


def image() -> np.ndarray:
    return np.full((60, 80, 3), 90, np.uint8)  # half as wide as the frame


def doubtful(count: int) -> list[DetectedFrame]:
    """Frames with one certain car and one doubted dog each, ten a second; another dog every ten frames."""
    frames = []
    for sequence in range(count):
        dog = track(2 + sequence // 10, "dog", "tentative", (0, 0, 20, 30))
        found = message(sequence, track(1, "car"), dog)
        frames.append(DetectedFrame(found["captured_ns"], image(), found))
    return frames


def test_collected_frames_are_a_data_set_to_train_on(tmp_path: Path) -> None:
    kept = list(collect(doubtful(200), tmp_path, "flight", interval_s=0.5, most=10))
    assert [path.name for path, _ in kept[:2]] == ["flight_0000004.jpg", "flight_0000014.jpg"]
    assert [reasons for _, reasons in kept[:2]] == [["doubted dog 2"], ["doubted dog 3"]]
    assert len(kept) == 10
    train = open_dataset(tmp_path, split="train")
    assert len(train.samples) == 10
    assert train.class_names == ("car", "dog")
    assert train.samples[0].class_ids.tolist() == [0, 1]
    assert train.samples[0].boxes_in(160, 120) == pytest.approx(np.array([MIDDLE, (0, 0, 20, 30)]), abs=0.01)
    # The same frames again are left as they are, corrected labels too; others are added.
    corrected = tmp_path / "labels" / "train" / "flight_0000004.txt"
    corrected.write_text("1 0.5 0.5 0.1 0.1\n")
    assert list(collect(doubtful(100), tmp_path, "flight", interval_s=0.5)) == []
    assert corrected.read_text() == "1 0.5 0.5 0.1 0.1\n"
    found = [message(sequence, track(1, "boat", "tentative")) for sequence in range(30)]
    others = [DetectedFrame(one["captured_ns"], image(), one) for one in found]
    # One doubt is one image, however long it lasts (up to ten seconds).
    assert len(list(collect(others, tmp_path, "other"))) == 1
    again = open_dataset(tmp_path, split="train")
    assert len(again.samples) == 11
    assert again.class_names == ("car", "dog", "boat")


def test_images_for_validation_are_apart_in_time(tmp_path: Path) -> None:
    # Every dog is doubted from its fifth frame on.
    for _ in collect(doubtful(3000), tmp_path, "flight", interval_s=0.5, most=1000):
        pass
    seconds = {
        split: [
            int(one.image.stem.rpartition("_")[2]) / 10 for one in open_dataset(tmp_path, split=split).samples
        ]
        for split in ("train", "val")
    }
    assert len(seconds["val"]) > 30
    assert len(seconds["train"]) > 200
    assert all(125 <= one % 150 < 145 for one in seconds["val"])
    assert all(one % 150 < 120 for one in seconds["train"])


TABLE = """# of my cameras
path: .
train: [images/train, more]  # two folders
test: images/test
"""


@pytest.mark.parametrize(
    ("names", "extended"),
    [
        ("names: [Car, 'ca t']  # mine\n", "names: [Car, 'ca t', \"dog\"]  # mine\n"),
        ("names:\n  - Car  # cars\n  - cat\nnc: 3\n", 'names:\n  - Car  # cars\n  - cat\n  - "dog"\nnc: 3\n'),
        ("names:\n- Car\n- cat", 'names:\n- Car\n- cat\n- "dog"'),
        ("names: []\r\n", 'names: ["car", "dog"]\r\n'),
        ("names: [Car, Dog]\n", "names: [Car, Dog]\n"),
    ],
)
def test_of_an_own_table_only_names_are_extended(tmp_path: Path, names: str, extended: str) -> None:
    (tmp_path / "data.yaml").write_bytes((TABLE + names).encode())
    assert len(list(collect(doubtful(20), tmp_path, "flight"))) == 2
    assert (tmp_path / "data.yaml").read_bytes().decode() == TABLE + extended
    (tmp_path / "more").mkdir()
    found = open_dataset(tmp_path, split="train")
    assert found.class_names is not None
    assert [found.class_names[one].casefold() for one in found.samples[0].class_ids] == ["car", "dog"]


def test_validation_folder_is_added_to_an_own_table(tmp_path: Path) -> None:
    (tmp_path / "data.yaml").write_text("names: [car, dog]\ntrain: images/train # mine")
    assert len(list(collect(doubtful(1400), tmp_path, "flight", interval_s=10))) > 10
    table = (tmp_path / "data.yaml").read_text()
    assert table == "names: [car, dog]\ntrain: images/train # mine\nval: images/val\n"
    assert open_dataset(tmp_path, split="val").samples


def recorded(folder: Path, **changes: str) -> Path:
    settings = plain_settings({"preview.annotate": "false", **changes})
    writer, converter = new_writer(folder), Converter("vehicle1")

    def write(path: str, payload: bytes, attachment: bytes | None = None) -> None:
        for one in converter.convert(path, payload, attachment):
            writer.write(*one)

    write("@record/run", dumps(run_record(settings, GuidanceOptions(), "service1")))
    for frame in doubtful(20):
        about = {"captured_ns": frame.captured_ns, "sequence": frame.message["sequence"]}
        tracks = [{**one, "confidence": 0.5} for one in frame.message["detections"]]
        write("detections", dumps({**frame.message, "detections": tracks}))
        write("image", cv2.imencode(".jpg", frame.image)[1].tobytes(), json.dumps(about).encode())
    writer.close()
    return writer.path


def test_command_collects_from_a_recording(tmp_path: Path) -> None:
    path = recorded(tmp_path / "recordings")
    result = CliRunner().invoke(app, ["learn", "collect", str(tmp_path / "set"), str(path)])
    assert result.exit_code == 0, result.stderr
    assert [line.partition(": ")[2] for line in result.stdout.splitlines()] == [
        "doubted dog 2",
        "doubted dog 3",
    ]
    assert len(open_dataset(tmp_path / "set").samples) == 2


@pytest.mark.parametrize("case", ["annotated", "no recording", "another table", "other folders"])
def test_unusable_input_is_one_line(tmp_path: Path, case: str) -> None:
    path = recorded(tmp_path / "recordings", **({"preview.annotate": "true"} if case == "annotated" else {}))
    if case == "no recording":
        path.write_bytes(b"text")
    tables = {"another table": "names: {0: car}\n", "other folders": "train: photos\nnames: [car]\n"}
    if case in tables:
        (tmp_path / "set").mkdir()
        (tmp_path / "set" / "data.yaml").write_text(tables[case])
    result = CliRunner().invoke(app, ["learn", "collect", str(tmp_path / "set"), str(path)])
    assert result.exit_code == 2
    assert len([line for line in result.stderr.splitlines() if line.startswith("companion:")]) == 1


def test_live_images_are_joined_with_their_detections() -> None:
    endpoint, ending = f"tcp/127.0.0.1:{free_port()}", threading.Event()
    service = zenoh.open(zenoh_config(ZenohSection(mode="peer", listen=(endpoint,))))

    def publish() -> None:
        for sequence in range(10_000):
            if ending.wait(0.02):
                return
            found = message(sequence, track(1, "car"))
            about = {"sequence": sequence, "captured_ns": found["captured_ns"], "annotated": False}
            service.put(DETECTIONS.key("vehicle1"), json.dumps(found))
            jpeg = cv2.imencode(".jpg", image())[1].tobytes()
            service.put(IMAGE.key("vehicle1"), jpeg, attachment=json.dumps(about))

    publishing = threading.Thread(target=publish)
    publishing.start()
    try:
        client = ZenohSection(mode="client", connect=(endpoint,), listen=())
        frames = live_frames(client, "vehicle1", None, ending)
        for _ in range(3):
            frame = next(frames)
            assert frame.captured_ns == frame.message["captured_ns"]
            assert frame.image.shape == (60, 80, 3)
        ending.set()
        assert list(frames) == []
    finally:
        ending.set()
        publishing.join()
        service.close()  # type: ignore[no-untyped-call]
