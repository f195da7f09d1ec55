"""Several cameras, and several models on one camera: a process each, all published, one steering."""

from __future__ import annotations

import asyncio
import json
import os
import queue
import secrets
import signal
from pathlib import Path
from typing import Any

import pytest

from companion.bus.client import listen
from companion.perception.cameras import open_cameras, threads_each
from companion.perception.supervisor import PerceptionSupervisor
from companion.settings import CameraSection, DetectorSection, Settings, SourceSection
from companion.settings.reading import ConfigurationError, load_settings, to_toml
from tests.companion.service_process import heartbeats, running_service

pytestmark = pytest.mark.realtime


def test_two_models_on_one_camera_and_the_second_steers(
    seeing: list[str], exported_model: Path, tmp_path: Path
) -> None:
    shared = f"companion-test-{secrets.token_hex(4)}"
    (tmp_path / "companion.toml").write_text(
        f'[guidance]\ncamera = "down"\n[source]\nshare = "{shared}"\n'
        f'[cameras.down.source]\nuri = "shm://{shared}"\n'
        f"[cameras.down.detector]\nmodel = {str(exported_model)!r}\nruntime = 'onnxruntime'\n"
        "image_size = 96\nclasses = ['boat']\n"
    )
    received: queue.SimpleQueue[tuple[str, dict[str, Any]]] = queue.SimpleQueue()

    def next_of(camera: str | None) -> dict[str, Any]:
        while True:
            key, message = received.get(timeout=30)
            own = "" if message["camera"] is None else f"cameras/{message['camera']}/"
            assert key == f"companion/vehicle1/{own}detections"
            if message["camera"] == camera:
                return message

    with (
        heartbeats() as port,
        running_service(port, ["--config", "companion.toml", *seeing], cwd=tmp_path) as service,
        service.client() as session,
    ):
        listen(session, "companion/*/**/detections", lambda key, text: received.put((key, json.loads(text))))
        statuses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
        first, down = next_of(None), next_of("down")
        assert (first["width"], first["height"]) == (down["width"], down["height"]) == (160, 120)
        status = statuses.get(timeout=10)
        assert status["perception"]["pid"] != status["cameras"]["down"]["pid"]
        assert status["targets"]["camera"] == "down"
        assert " class 'bicycle'" in service.command("seek bicycle")["reason"]
        assert "the air" in service.command("seek boat")["reason"]

        os.kill(status["cameras"]["down"]["pid"], signal.SIGKILL)
        service.wait_for_line("camera down: perception lost")
        service.wait_for_line("camera down: perception restored")
        # Both cameras have the model of rendered scenes, and read frames that are not the simulator's.
        (line,) = [line for line in service.lines if "add --pull" in line]
        assert "'small.onnx'" in line.replace(str(exported_model), "small.onnx")
        while not received.empty():
            received.get()
        next_of("down")
        while (status := statuses.get(timeout=10))["cameras"]["down"]["restarts"] == 0:
            pass
        assert status["perception"]["restarts"] == 0
    assert not Path("/dev/shm", shared).exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[cameras.down.detectr]\nx = 1", ["[cameras.down.detectr]", "did you mean detector"]),
        ('[cameras."a b".source]\nuri = "x.mp4"', ["a camera's name", "'a b'"]),
        ("[cameras.down.detector]\nconfidence = 3", ["cameras.down.detector.confidence", "0 to 1", "got 3"]),
        (
            "[cameras.down.detector]\nmodle = 3",
            ["cameras.down.detector.modle", "did you mean detector.model"],
        ),
        (
            '[cameras.d.source]\nuri = "-"\n[cameras.up.source]\nuri = "-"',
            ["cameras.up.source.uri", "opened once", "shm://NAME"],
        ),
        ('[guidance]\ncamera = "up"', ["guidance.camera", "'up'", "cameras: none"]),
        ('[cameras.a.source]\nuri = "shm://f"\nshare = "f"', ["cameras.a.source.share", "its own frames"]),
        (
            '[cameras.a.source]\nuri = "a.mp4"\nshare = "f"\n[cameras.b.source]\nuri = "b.mp4"\nshare = "f"',
            ["cameras.b.source.share", "cameras.a.source.share", "'f'"],
        ),
        (
            '[recording]\nvideo = "f.webm"\n[cameras.a.recording]\nvideo = "f.webm"',
            ["recording.video", "f.webm"],
        ),
        (
            '[cameras.a.source]\nuri = "a.mp4"\n[cameras.a.detector]\nrate_hz = 0.5',
            ["cameras.a.tracker.max_age_s", "cameras.a.detector.rate_hz", "2 s"],
        ),
        ("[cameras]\ndown = 1", ["cameras.down", "must hold sections", "got 1"]),
    ],
)
def test_invalid_camera_is_one_line(text: str, words: list[str], tmp_path: Path) -> None:
    path = tmp_path / "companion.toml"
    path.write_text(f'[source]\nuri = "street.mp4"\n{text}\n')
    with pytest.raises(ConfigurationError) as caught:
        load_settings(path, {}, {})
    (problem,) = caught.value.problems
    for word in words:
        assert word in problem


def test_cameras_round_trip_through_toml(tmp_path: Path) -> None:
    path = tmp_path / "companion.toml"
    path.write_text('[cameras.down.source]\nuri = "down.mp4"\n[cameras.up-2.source]\nuri = "up.mp4"\n')
    settings = load_settings(path, {"cameras.down.detector.confidence": "0.4"}, {})
    assert list(settings.cameras) == ["down", "up-2"]
    assert settings.of_camera("down").detector.confidence == 0.4
    assert settings.of_camera(None).detector.confidence == settings.detector.confidence
    path.write_text(to_toml(settings))
    assert load_settings(path, {}, {}) == settings


def test_automatic_threads_leave_a_processor_free() -> None:
    processors = len(os.sched_getaffinity(0))
    asking, off = DetectorSection(), DetectorSection(enabled=False)
    for cameras in range(1, 9):
        each = threads_each([asking] * cameras)
        assert each == 1 or (each > 1 and cameras * each < processors)
    # A disabled detector gets no threads, a configured number is not changed.
    assert threads_each([off, asking, off]) == threads_each([asking])
    assert threads_each([DetectorSection(threads=processors), asking]) == 1


@pytest.mark.parametrize(("roll_deg", "warnings"), [(180.0, 1), (0.0, 0)])
def test_camera_turned_twice_is_warned_about(
    roll_deg: float, warnings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def started(_: PerceptionSupervisor) -> None:
        """No worker."""

    monkeypatch.setattr(PerceptionSupervisor, "start", started)
    events: list[tuple[str, str]] = []
    (camera,) = open_cameras(
        Settings(source=SourceSection(rotate_deg=180), camera=CameraSection(mount_roll_deg=roll_deg)),
        on_result=lambda camera, result: None,
        on_preview=lambda camera, preview: None,
        on_event=lambda level, text: events.append((level, text)),
        on_calibration=lambda: None,
    )
    asyncio.run(camera.start())
    assert [level for level, _ in events] == ["warning"] * warnings
    assert all("source.rotate_deg" in text and "mount_roll_deg" in text for _, text in events)
