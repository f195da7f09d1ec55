"""`mavlink-sim` with a scene: its objects in the truth, its camera at several outputs."""

from __future__ import annotations

import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mavlink_sim.cli.main import main
from mavlink_sim.testing import free_port
from vision.shared_frame import SHARED_MEMORY_DIRECTORY, SharedFrameReader, segment_path

pytestmark = [
    pytest.mark.skipif(not SHARED_MEMORY_DIRECTORY.is_dir(), reason="needs Linux's /dev/shm"),
    pytest.mark.realtime,
]
DEADLINE_S = 90.0
SCENE = """
[ground]
kinds = ["concrete"]
tile_texels = 256
[[objects]]
class = "car"
place_m = [9, 0]
[[objects]]
class = "person"
path = { waypoints_m = [[8, -2], [8, 2]], speed_mps = 1, repeat = "back_and_forth" }
[camera]
width = 160
height = 120
rate_hz = 20
latency_ms = 50
[camera.mount]
pitch_deg = 5
[camera.depth]
maximum_m = 15
"""


def test_scene_flight_with_three_camera_outputs(tmp_path: Path) -> None:
    scene, truth, seen = tmp_path / "field.toml", tmp_path / "truth.jsonl", tmp_path / "seen.jsonl"
    scene.write_text(SCENE, "utf-8")
    name = f"test-scene-{os.getpid()}-{secrets.token_hex(4)}"
    port = free_port(socket.SOCK_STREAM)
    command = [sys.executable, "-m", "mavlink_sim", "--scene", str(scene), "--camera", name]
    command += ["--camera-output", f"http://127.0.0.1:{port}", "--camera-output", "pipe:-"]
    command += ["--truth", str(truth), "--camera-truth", str(seen)]
    for option in ("onboard", "gcs"):
        command += [f"--{option}-bind", "0", f"--{option}-port", str(free_port(socket.SOCK_DGRAM))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as vehicle:
        assert vehicle.stdout is not None
        try:
            raw = vehicle.stdout.read(160 * 120 * 3)  # standard output carries only images
            piped = np.frombuffer(raw, np.uint8).reshape(120, 160, 3)
            with urllib.request.urlopen(
                f"http://127.0.0.1:{port}/snapshot.jpg", timeout=DEADLINE_S
            ) as answer:
                served = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_COLOR)
            with SharedFrameReader(name) as reader:
                frame = reader.latest()
            assert frame is not None
            assert frame.depth_m is not None
            assert np.nanmax(frame.depth_m) <= 15.0
            assert served is not None
            for image in (piped, served):
                assert np.abs(image.astype(int) - frame.image).mean() < 12.0
            deadline = time.monotonic() + DEADLINE_S
            lines: list[dict[str, Any]] = []
            while len(lines) < 20:
                assert time.monotonic() < deadline, "no truth of frames"
                time.sleep(0.05)
                lines = [
                    json.loads(line) for line in seen.read_text("utf-8").splitlines(True) if line[-1] == "\n"
                ]
        finally:
            vehicle.send_signal(signal.SIGTERM)
            vehicle.stdout.close()
            assert vehicle.wait(DEADLINE_S) == 0
    segment_path(name).unlink(missing_ok=True)
    easts = [
        item["position_ned_m"][1] for line in lines for item in line["objects"] if item["identifier"] == 1
    ]
    assert max(easts) - min(easts) > 0.5
    stamps = [line["stamp_ns"] for line in lines]
    assert stamps == sorted(stamps)
    assert {"car", "person"} == {item["class_name"] for line in lines for item in line["objects"]}
    flight = [json.loads(line) for line in truth.read_text("utf-8").splitlines()]
    assert {item["class_name"] for item in flight[-1]["objects"]} == {"car", "person"}
    assert flight[0]["objects"][1]["position_ned_m"] != flight[-1]["objects"][1]["position_ned_m"]


def test_invalid_scene_explained_and_not_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "field.toml"
    scene.write_text("[camera]\nwidth = 'wide'\n", "utf-8")
    for arguments, message in (
        (["--scene", str(scene), "--camera", "unborn"], "camera.width"),
        (["--camera-output", "gopher://x"], "shm://NAME"),
    ):
        monkeypatch.setattr("sys.argv", ["mavlink-sim", "--onboard-bind=0", "--gcs-bind=0", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line
