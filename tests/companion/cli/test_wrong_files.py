"""Every reader of a file on the command line, given every wrong file: one line that names it, exit code 2."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer.main
from pymavlink.dialects.v20 import common as mavlink

from companion.cli import app
from companion.recording.files import write_messages
from companion.settings.reading import flags
from mavlink_sim.camera.scene_file import SceneError, load_scene
from tests.companion.command_line import companion_here
from vision.calibration_files.camera_info import write_camera_info
from vision.camera_model import CameraModel

# Parameter → its readers: the arguments, with {} for the file, and the suffix that selects the reader.
_DETECT = "detect {} --model none --limit 1"
_TRAIN = "learn train --from small.pt --steps 1"
_LENS = "calibrate lens {} --board chessboard 7x5 --square 0.03"
_DEPTH_CAMERA = (
    "calibrate lens {source} --depth-source {depth_source} --board chessboard 7x5 --square 0.03 "
    "--calibration {calibration} --depth-calibration {depth_calibration}"
)
_MODELS = (".pt", ".pth", ".safetensors", ".onnx", ".xml", ".engine", ".torchscript", ".tflite")
_SOURCES = (".mp4", ".jpg", ".npy")


def _depth_camera(name: str) -> str:
    others = {"source": "frame.png", "depth_source": "frame.png"}
    others |= {"calibration": "camera.yaml", "depth_calibration": "camera.yaml"}
    return _DEPTH_CAMERA.format(**{**others, name: "{}"})


READERS: dict[str, tuple[tuple[str, str], ...]] = {
    "detect source": (
        *((_DETECT, suffix) for suffix in _SOURCES),
        ("detect {} --model small.onnx --limit 1", ".mp4"),
        ("detect {} --model none --depth", ".mp4"),
        ("detect {} --model none --cloud out.ply", ".mp4"),
        ("detect {} --model none --markers 4X4_50", ".mp4"),
    ),
    "detector.model": (("detect frame.png --model {}", ".onnx"), ("detect frame.png --model {}", ".pt")),
    "ros2 node python": (("ros2 node --python {}", ".txt"),),
    "mcp token_file": (("mcp --listen 127.0.0.1:0 --token-file {}", ".txt"),),
    "send file": (("send --file {} --check", ".toml"),),
    "log replay files": (("log replay {}", ".mcap"),),
    "learn collect files": (("learn collect folder {}", ".mcap"),),
    "learn evaluate dataset": (("learn evaluate {}", ".yaml"), ("learn evaluate {}", ".json")),
    "learn evaluate model": (("learn evaluate labelled --model {}", ".pt"),),
    "learn evaluate images": (("learn evaluate annotations.json --images {}", ".zip"),),
    "learn train start": (("learn train --data labelled --steps 1 --from {}", ".pt"),),
    "learn train data": ((f"{_TRAIN} --data {{}}", ".yaml"),),
    "learn train validation": ((f"{_TRAIN} --data labelled --validation {{}}", ".yaml"),),
    "models show file": (
        *(("models show {}", suffix) for suffix in _MODELS),
        ("models show {} --compare frame.png", ".pt"),
    ),
    "models export file": (("models export {} --to onnx", ".pt"),),
    "models export calibrate": (
        ("models export small.pt --to onnx --output out.onnx --precision int8 --calibrate {}", ".zip"),
    ),
    "models show compare": (("models show small.pt --compare {}", ".onnx"),),
    "models show images": (("models show small.pt --compare small.onnx --images {}", ".zip"),),
    "calibrate lens source": ((_LENS, ".mp4"), (_depth_camera("source"), ".mp4")),
    "calibrate lens depth_source": ((_depth_camera("depth_source"), ".mp4"),),
    "calibrate lens calibration": ((_depth_camera("calibration"), ".yaml"),),
    "calibrate lens depth_calibration": ((_depth_camera("depth_calibration"), ".yaml"),),
    "calibrate mount source": (("calibrate mount {} --marker 0 --size 0.1", ".mp4"),),
    "calibrate mount calibration": (
        ("calibrate mount frame.png --marker 0 --size 0.1 --calibration {}", ".yaml"),
    ),
    "bench detector model": (("bench detector --model {} --frames 5", ".onnx"),),
    "bench detector against": (("bench detector --against {}", ".json"),),
    "log show paths": (("log show {}", ".mcap"), ("log show --objects kml {}", ".mcap")),
    "log convert file": (("log convert {} out.mcap", ".mcap"), ("log convert {} out.tlog", ".mcap")),
    "config": (("describe settings --config {}", ".toml"),),
    "vehicle.signing_key_file": (("describe settings --check --vehicle-signing-key-file {}", ".key"),),
    "signing send key_file": (("signing send --yes --key-file {}", ".key"),),
    "signing send present_key_file": (("signing send --yes --off --present-key-file {}", ".key"),),
    "init output": (("init --yes --dry-run --output {}", ".toml"),),
    "source.depth": (("detect frame.png --model none --depth --source-depth {}", ".npy"),),
    "source.depth_calibration_file": (
        ("describe settings --source-depth frame.png --source-depth-calibration-file {}", ".yaml"),
    ),
    "camera.calibration_file": (("describe settings --camera-calibration-file {}", ".yaml"),),
    "markers.boards_file": (("describe settings --markers-boards-file {}", ".toml"),),
    "markers.map_file": (("describe settings --markers-map-file {}", ".toml"),),
    "zenoh.config_file": (("describe settings --check --zenoh-config-file {}", ".json5"),),
    "zenoh.child_config_file": (("describe settings --check --zenoh-child-config-file {}", ".json5"),),
    "dashboard.token_file": (("describe settings --check --dashboard-token-file {}", ".txt"),),
    "mqtt.password_file": (
        ("describe settings --check --mqtt-url mqtt://broker --mqtt-password-file {}", ".txt"),
    ),
    "mqtt.ca_file": (("describe settings --check --mqtt-url mqtts://broker --mqtt-ca-file {}", ".pem"),),
    "ground_station.video_token_file": (
        ("describe settings --check --ground-station-video-token-file {}", ".txt"),
    ),
    "language.key_file": (("describe settings --check --language-key-file {}", ".txt"),),
}
_PLAN = {"fileType": "Plan", "groundStation": "QGroundControl", "mission": {"items": []}, "version": 1}


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    path.chmod(0o600)


def make_wrong(folder: Path, kind: str, suffix: str) -> Path:
    path = folder / f"given{suffix}"
    if kind == "folder":
        path.mkdir()
    elif kind == "unreadable":
        path.symlink_to(path.name)  # a loop: unreadable for root too
    elif kind == "fifo":
        os.mkfifo(path)  # nobody writes to it
    elif kind == "device":
        path.symlink_to("/dev/null")
    elif kind == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("readme.txt", "hello")
        path.chmod(0o600)
    elif kind != "missing":
        _write(path, CONTENTS[kind])
    return path


def _tlog() -> bytes:
    """Telemetry as ground stations log it: each message after eight bytes of time, microseconds."""
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = sender.heartbeat_encode(2, 12, 0, 0, 3).pack(sender)
    return b"".join(struct.pack(">Q", 1_700_000_000_000_000 + 1000 * n) + frame for n in range(50))


CONTENTS = {
    "empty": b"",
    "random": np.random.default_rng(1).integers(0, 256, 5000, np.uint8).tobytes(),
    "html": b"<!DOCTYPE html>\n<html><head><title>Sign in</title></head><body></body></html>\n",
    "lfs": b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4d" * 32 + b"\nsize 12345\n",
    "utf16": 'name = "caf\u00e9"\n'.encode("utf-16"),
    "jpeg": cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes(),
    "mp4_header": b"\0\0\0\x20ftypisom" + bytes(20) + b"\0\0\x10\0mdat" + bytes(4000),
    "toml": b'title = "x"\n[owner]\nname = "y"\n',
    "json": b'{"a": [1, 2, 3]}\n',
    "xml": b'<?xml version="1.0"?>\n<annotation><object/></annotation>\n',
    "plan": json.dumps(_PLAN).encode(),
    "waypoints": b"QGC WPL 110\n0\t1\t0\t16\t0\t0\t0\t0\t47.4\t8.5\t488\t1\n",
    "line": b"a" * 3_000_000,
    "sqlite": b"SQLite format 3\0" + bytes(4080),
    "bag": b"#ROSBAG V2.0\nE\0\0\0" + bytes(4000),
    "ulog": b"ULog\x01\x12\x35\x01" + bytes(200),
    "tlog": _tlog(),
}
KINDS = (*CONTENTS, "zip", "folder", "missing", "unreadable", "device", "fifo")

# Other parameters that are text or paths: written, not read; or no files.
WRITTEN = {
    "demo output", "detect save", "detect cloud", "detect cloud_view", "describe schema", "markers output",
    "log record directory", "log convert output", "learn collect folder", "learn evaluate misses",
    "learn train output", "models show folder", "models pull folder", "models export output",
    "calibrate lens output", "calibrate lens report", "recording.video", "recording.directory",
    "signing new file", "bench chaos log",
}  # fmt: skip
# Read by what other rows run: the service opens them as `detect` does.
ELSEWHERE = {"view source", "play scene", "log replay model", "source.uri"}
NO_FILES = {
    "seeds", "ray", "vehicle_url", "classes", "runtime", "precision", "device", "command", "key", "sentence",
    "allow", "listen", "changes", "camera", "split", "policy", "algorithm", "name", "url", "to", "board",
    "dictionary", "printed", "identifiers", "paper", "frame", "markers", "ros_arguments", "serial",
}  # fmt: skip
# What these readers take: an image by its content; any text as a passphrase or key; an empty settings file.
_IMAGES = {
    name: {"jpeg"}
    for name, rows in READERS.items()
    if name.endswith((" source", " depth_source")) and not name.startswith("models")
}
# To a pipe somebody may write later.
ACCEPTED: dict[str, set[str]] = {name: kinds | {"fifo"} for name, kinds in _IMAGES.items()} | {
    "source.depth": {"fifo"},
    "config": {"empty", "device"},
    "vehicle.signing_key_file": {"toml", "json"},
    "signing send key_file": {"toml", "json"},
    "signing send present_key_file": {"toml", "json"},
    "init output": {"missing", "empty"},
    "language.key_file": {"json"},
    "mqtt.password_file": {"json"},
    "log show paths": {"folder"},
}
_FOREIGN = re.compile(r"\b[A-Z]\w*(Error|Exception)\b|Traceback|[Pp]rotobuf|\.cpp|site-packages|Errno")


def _parameters(command: Any, name: str = "") -> set[str]:
    if hasattr(command, "commands"):
        below = command.commands.items()
        return set().union(*(_parameters(each, f"{name} {word}".strip()) for word, each in below))
    given = (each for each in command.params if each.type.name in ("path", "text", "str"))
    return {f"{name} {each.name}" for each in given if each.name not in ("config_file", *NO_FILES)}


def test_every_file_of_the_command_line_is_tried() -> None:
    found = _parameters(typer.main.get_command(app))
    named = re.compile(r"_file$|^source\.(uri|depth)$|^detector\.model$|^recording\.(video|directory)$")
    found |= {flag.key for flag in flags() if named.search(flag.key)}
    assert found == (READERS.keys() | WRITTEN | ELSEWHERE) - {"config"}


@pytest.fixture
def right(tmp_path: Path, small_model: Path, exported_model: Path) -> Path:
    """A folder with the files that the other arguments name."""
    cv2.imwrite(str(tmp_path / "frame.png"), np.zeros((480, 640, 3), np.uint8))
    write_camera_info(tmp_path / "camera.yaml", CameraModel(640, 480, 600.0, 600.0, 320.0, 240.0), "camera")
    labelled = tmp_path / "labelled"
    (labelled / "images").mkdir(parents=True)
    (labelled / "labels").mkdir()
    shutil.copy(tmp_path / "frame.png", labelled / "images" / "a.png")
    (labelled / "labels" / "a.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    coco = {
        "images": [{"id": 1, "file_name": "a.png"}],
        "annotations": [],
        "categories": [{"id": 1, "name": "x"}],
    }
    (tmp_path / "annotations.json").write_text(json.dumps(coco))
    shutil.copy(small_model, tmp_path / "small.pt")
    shutil.copy(exported_model, tmp_path / "small.onnx")
    write_messages(tmp_path / "flight.mcap", (), {})
    return tmp_path


@pytest.mark.parametrize(
    ("name", "arguments", "suffix"),
    [
        pytest.param(name, arguments, suffix, id=f"{name}{suffix}")
        for name, rows in READERS.items()
        for arguments, suffix in rows
    ],
)
def test_a_wrong_file_is_one_line(
    name: str,
    arguments: str,
    suffix: str,
    right: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(right / "cache"))
    faults = []
    for kind in KINDS:
        if kind in ACCEPTED.get(name, ()):
            continue
        path = make_wrong(right, kind, suffix)
        words = [word.replace("{}", path.name) for word in arguments.split()]
        try:
            done = companion_here(*words, cwd=right)
        except Exception as error:  # a traceback for a person
            faults.append((kind, repr(error)))
        else:
            lines = done.stderr.splitlines()
            # TOML is read, and every problem of its keys is a line.
            whole = all("given" in line for line in lines) and (len(lines) == 1 or kind == "toml")
            if done.returncode != 2 or not whole or _FOREIGN.search(done.stderr):
                faults.append((kind, f"{done.returncode}: {done.stderr}"))
        path.rmdir() if kind == "folder" else path.unlink(missing_ok=True)
    assert not faults
    assert capfd.readouterr().err == ""  # of libraries that write to standard error themselves


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_scene_is_one_line(kind: str, tmp_path: Path) -> None:
    path = make_wrong(tmp_path, kind, ".toml")
    if kind in ("empty", "device"):  # a scene of defaults
        assert load_scene(path).world.objects == ()
        return
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    lines = str(caught.value).splitlines()
    assert all("given.toml" in line for line in lines)
    assert len(lines) == 1 or kind == "toml"
    assert not _FOREIGN.search(str(caught.value))
    said = {"plan": "QGroundControl", "lfs": "git lfs pull", "html": "HTML page", "sqlite": "ROS 2"}
    assert said.get(kind, "") in lines[0]


@pytest.mark.parametrize("command", ["companion.cli play", "mavlink_sim"])
def test_programs_name_a_wrong_scene(command: str, tmp_path: Path) -> None:
    path = make_wrong(tmp_path, "plan", ".toml")
    words = [sys.executable, "-m", *command.split(), "--scene", path.name]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "given.toml" in line
    assert "QGroundControl" in line


@pytest.mark.parametrize(
    "command",
    ["models show {}", "detect frame.png --model {}", "learn train --data labelled --steps 1 --from {}"],
)
def test_a_checkpoint_of_classification_says_what_it_is(
    command: str, right: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    from tests.vision.foreign_checkpoints import foreign_classes, save_foreign

    classes = foreign_classes(monkeypatch, {"ClassificationModel": "ultralytics.nn.tasks"})
    save_foreign(right / "given.pt", classes["ClassificationModel"]())
    done = companion_here(*(word.replace("{}", "given.pt") for word in command.split()), cwd=right)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "given.pt" in line
    assert "classification" in line
