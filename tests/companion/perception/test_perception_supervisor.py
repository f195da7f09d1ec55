"""The supervisor with real workers: real processes, files and a tiny, untrained network."""

from __future__ import annotations

import asyncio
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.perception.supervisor import PerceptionStartError, PerceptionState, PerceptionSupervisor
from companion.perception.worker import NICENESS
from companion.scheduling import DEFAULT_NS, SHORTEST_NS, set_scheduler_slice
from companion.settings.reading import Settings, load_settings
from tests.companion.vehicle.thread_slice import slice_of
from vision.pipeline import PerceptionResult
from vision.sources import SourceSettings, open_source
from vision.tracking import Selected, SelectRequest

pytestmark = pytest.mark.realtime

DEADLINE_S = 60.0


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((48, 64, 3), 80 * number, np.uint8))
    return folder


class Recorder:
    """Records a supervisor's results and events."""

    def __init__(self) -> None:
        self.results: list[PerceptionResult] = []
        self.events: list[tuple[str, str]] = []

    def has_event(self, *words: str) -> bool:
        return any(all(word in text for word in words) for _, text in self.events)


async def until(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen in time"
        await asyncio.sleep(0.01)


def settings_of(source: Path | str, model: Path | None = None, /, **overrides: str) -> Settings:
    values = {
        "source.uri": str(source),
        "source.loop": "true",
        "source.rate_hz": "50",
        "detector.enabled": "false",
        **({} if model is None else {"detector.enabled": "true", "detector.model": str(model)}),
        "detector.image_size": "64",
        "detector.threads": "1",
        "detector.precision": "float32",
        **overrides,
    }
    return load_settings(os.devnull, values, {})


@asynccontextmanager
async def supervised(settings: Settings) -> AsyncIterator[tuple[PerceptionSupervisor, Recorder]]:
    recorder = Recorder()
    supervisor = PerceptionSupervisor(
        settings, on_result=recorder.results.append, on_event=lambda *event: recorder.events.append(event)
    )
    await supervisor.start()
    try:
        yield supervisor, recorder
    finally:
        await supervisor.stop()


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


async def test_results_have_classes_stamps_and_timing(photos: Path, exported_model: Path) -> None:
    set_scheduler_slice()  # as the service's loop
    async with supervised(settings_of(photos, exported_model, **{"detector.confidence": "0"})) as (
        supervisor,
        recorder,
    ):
        await until(lambda: len(recorder.results) >= 5)
        set_scheduler_slice(DEFAULT_NS)
        status = supervisor.status
        first = recorder.results[0]
        assert supervisor.class_names == status.class_names == ("person", "car", "boat")
        assert status.state is PerceptionState.RUNNING
        assert status.results == len(recorder.results)
        assert status.frames >= status.results
        assert status.rate_hz > 0
        assert status.age_s is not None
        assert status.newest is recorder.results[-1]
        assert (first.width, first.height) == (64, 48)
        assert first.captured_ns < first.inferred_ns < time.monotonic_ns()
        assert {"preprocess", "inference", "postprocess", "range", "total"} <= first.timing_ms.keys()
        assert len(first.detections) > 0
        sequences = [result.sequence for result in recorder.results]
        assert sequences == sorted(set(sequences))
        pid = status.pid
        assert pid is not None
        own = os.getpriority(os.PRIO_PROCESS, 0)
        assert os.getpriority(os.PRIO_PROCESS, pid) == min(own + NICENESS, 19)
        assert slice_of(pid) != SHORTEST_NS
        loaded = await asyncio.to_thread(Path(f"/proc/{pid}/maps").read_text)
        assert "onnxruntime" in loaded
        assert "libtorch" not in loaded
    assert not alive(pid)
    assert supervisor.status.state is PerceptionState.STOPPED
    assert supervisor.status.pid is None


async def test_without_a_detector_nothing_is_detected_or_selected(photos: Path) -> None:
    async with supervised(settings_of(photos)) as (supervisor, recorder):
        await until(lambda: len(recorder.results) >= 3)
        assert all(len(result.detections) == 0 for result in recorder.results)
        assert supervisor.class_names == ()
        answer = await supervisor.select(SelectRequest((0.25, 0.25, 0.5, 0.5)))
        assert not answer.success
        assert "detector.enabled " in answer.reason
        assert "tracker.enabled " in answer.reason


async def test_worker_of_idle_priority_is_interrupted_by_every_program(photos: Path) -> None:
    async with supervised(settings_of(photos, **{"detector.priority": "idle"})) as (supervisor, _):
        # Not until it has results: beside other tests it may get almost no time.
        await until(lambda: (pid := supervisor.status.pid) and os.sched_getscheduler(pid) == os.SCHED_IDLE)


async def test_detector_every_skips_frames(photos: Path) -> None:
    async with supervised(settings_of(photos, **{"detector.every": "5"})) as (supervisor, recorder):
        await until(lambda: len(recorder.results) >= 4)
        dropped = supervisor.status.dropped
        gaps = np.diff([result.sequence for result in recorder.results])
        assert gaps.min() >= 5
        assert gaps.sum() <= 5 * len(gaps) + dropped


async def test_end_of_source_finishes_perception(photos: Path) -> None:
    settings = settings_of(photos, **{"source.loop": "false"})
    async with supervised(settings) as (supervisor, recorder):
        await until(lambda: supervisor.status.state is PerceptionState.FINISHED)
        assert recorder.events[-1][0] == "info"
        assert "of stream" in recorder.events[-1][1]
        assert supervisor.status.restarts == 0
        assert supervisor.status.frames + supervisor.status.dropped >= 3


async def test_start_failure_is_one_line(photos: Path) -> None:
    supervisor = PerceptionSupervisor(
        settings_of("/nowhere/street.mp4"), on_result=lambda _: None, on_event=lambda *_: None
    )
    with pytest.raises(PerceptionStartError) as caught:
        await supervisor.start()
    assert "/nowhere/street.mp4: no such file" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert supervisor.status.state is PerceptionState.FAILED
    assert supervisor.status.pid is None
    await supervisor.stop()


@pytest.fixture
def patterned(tmp_path: Path) -> Path:
    """A still image with a pattern."""
    folder = tmp_path / "patterned"
    folder.mkdir()
    blocks = np.random.default_rng(2).integers(0, 255, (12, 16), np.uint8)
    image = cv2.resize(blocks, (320, 240), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(folder / "0.png"), image)
    return folder


async def test_selected_object_is_a_track_until_its_worker_ends(
    patterned: Path, exported_model: Path
) -> None:
    # An untrained network has low confidences: nothing is detected.
    settings = settings_of(patterned, exported_model, **{"detector.confidence": "0.9"})
    async with supervised(settings) as (supervisor, recorder):
        await until(lambda: recorder.results)
        answer = await supervisor.select(SelectRequest((0.25, 0.25, 0.25, 0.25)))
        assert answer == Selected(True, "track 1, a target", 1, "target")
        before = len(recorder.results)
        await until(lambda: len(recorder.results) > before + 3)
        (record,) = recorder.results[-1].detections.records()
        assert (record["track_id"], record["class_name"], record["track_state"]) == (1, "target", "confirmed")
        assert record["xyxy"] == pytest.approx([80, 60, 160, 120], abs=4.0)
        assert (await supervisor.select(SelectRequest(None))).reason == "track 1 ended"
        assert (await supervisor.select(SelectRequest((0.5, 0.25, 0.25, 0.25)))).track_id == 2
        pid = supervisor.status.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        await until(lambda: supervisor.status.restarts == 1 and supervisor.state is PerceptionState.RUNNING)
        assert recorder.has_event("track 2, ", "selected object", "lost with ")
        after = len(recorder.results)
        await until(lambda: len(recorder.results) > after)
        assert "end" in [event.kind.value for event in recorder.results[after].track_events]
        assert len(recorder.results[-1].detections) == 0
        assert (await supervisor.select(SelectRequest((0.5, 0.25, 0.25, 0.25)))).track_id == 3
    stopped = await supervisor.select(SelectRequest(None))
    assert not stopped.success
    assert "not running (stopped)" in stopped.reason


async def test_selection_fails_when_the_worker_dies_before_it_answers(
    patterned: Path, exported_model: Path
) -> None:
    async with supervised(settings_of(patterned, exported_model)) as (supervisor, recorder):
        await until(lambda: recorder.results)
        pid = supervisor.status.pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        asked = asyncio.create_task(supervisor.select(SelectRequest((0.25, 0.25, 0.25, 0.25))))
        await asyncio.sleep(0)
        os.kill(pid, signal.SIGKILL)
        answer = await asked
        assert not answer.success
        assert "has ended" in answer.reason


async def test_killed_worker_is_replaced_and_sequence_continues(photos: Path, tmp_path: Path) -> None:
    settings = settings_of(photos, **{"recording.video": str(tmp_path / "flight.webm")})
    async with supervised(settings) as (supervisor, recorder):
        await until(lambda: len(recorder.results) >= 3)
        pid = supervisor.status.pid
        assert pid is not None
        ended = os.pidfd_open(pid)
        os.kill(pid, signal.SIGKILL)
        assert select.select([ended], [], [], DEADLINE_S)[0]
        os.close(ended)
        # Writes before its death is detected, as in flight, must not prevent the restart.
        for watched in (True, False, True):
            supervisor.watch(watched)
        await until(lambda: supervisor.status.state is PerceptionState.RESTARTING)
        before = len(recorder.results)
        await until(lambda: len(recorder.results) > before + 3)
        assert recorder.has_event(f"process {pid} was killed", "SIGKILL; ", "restarting (1 of 5)")
        assert recorder.has_event("perception restored")
        assert supervisor.status.restarts == 1
        assert supervisor.status.pid not in (None, pid)
        sequences = [result.sequence for result in recorder.results]
        assert sequences == sorted(set(sequences))
    # The new worker does not overwrite the video.
    assert (tmp_path / "flight.webm").exists()
    with open_source(str(tmp_path / "flight-2.webm"), SourceSettings()) as source:
        assert len(list(source)) >= 1


async def test_stopped_worker_is_stuck_and_replaced(photos: Path) -> None:
    async with supervised(settings_of(photos)) as (supervisor, recorder):
        await until(lambda: len(recorder.results) >= 3)
        pid = supervisor.status.pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        await until(lambda: recorder.has_event(f"process {pid} is stuck"))
        assert not alive(pid)
        before = len(recorder.results)
        await until(lambda: len(recorder.results) > before)
        assert supervisor.status.state is PerceptionState.RUNNING


async def test_repeatedly_dying_worker_is_given_up(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.perception.supervisor._BACK_OFF_S", (0.01,))
    monkeypatch.setattr("companion.perception.supervisor.MAX_RESTARTS", 2)
    async with supervised(settings_of(photos)) as (supervisor, recorder):
        while supervisor.status.state is not PerceptionState.FAILED:
            if supervisor.status.pid is not None and supervisor.status.state is PerceptionState.RUNNING:
                os.kill(supervisor.status.pid, signal.SIGKILL)
                await until(lambda: supervisor.status.state is not PerceptionState.RUNNING)
            await asyncio.sleep(0.01)
        assert supervisor.status.restarts == 2
        assert recorder.events[-1][0] == "error"
        assert "3 times in 60 s" in recorder.events[-1][1]


async def test_incomplete_video_is_reported_at_stop(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.perception.process.SHORTEST_S", 0.3)
    monkeypatch.setattr("companion.perception.supervisor.STOP_S", 1.5)
    monkeypatch.setattr("companion.perception.supervisor.TERMINATE_S", 0.3)
    video = str(tmp_path / "flight.webm")
    async with supervised(settings_of(photos, **{"recording.video": video})) as (supervisor, recorder):
        await until(
            lambda: supervisor.status.stuck_after_s is not None and supervisor.status.stuck_after_s < 1.0
        )
        pid = supervisor.status.pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)  # as silent as a slow encoder
        await supervisor.stop()
    assert not alive(pid)
    level, text = recorder.events[-1]
    assert level == "warning"
    assert f"process {pid} was killed" in text
    assert "SIGKILL; " in text
    assert f"the video {video}" in text


async def test_worker_death_during_stop_is_reported(photos: Path) -> None:
    async with supervised(settings_of(photos)) as (supervisor, recorder):
        pid = supervisor.status.pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        stopping = asyncio.create_task(supervisor.stop())
        await asyncio.sleep(0)
        os.kill(pid, signal.SIGKILL)
        await stopping
    assert recorder.has_event(f"process {pid} was killed", "SIGKILL")


async def test_cancelled_start_leaves_no_process(photos: Path, exported_model: Path) -> None:
    supervisor = PerceptionSupervisor(
        settings_of(photos, exported_model), on_result=lambda _: None, on_event=lambda *_: None
    )
    starting = asyncio.create_task(supervisor.start())
    await until(lambda: supervisor.status.pid is not None)
    pid = supervisor.status.pid
    assert pid is not None
    starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting
    assert not alive(pid)


async def test_failing_callback_is_reported(photos: Path) -> None:
    events: list[tuple[str, str]] = []

    def broken(_result: PerceptionResult) -> None:
        raise ZeroDivisionError

    supervisor = PerceptionSupervisor(
        settings_of(photos), on_result=broken, on_event=lambda *event: events.append(event)
    )
    await supervisor.start()
    await until(lambda: supervisor.status.state is PerceptionState.FAILED)
    assert events[-1][0] == "error"
    assert "ZeroDivisionError" in events[-1][1]
    assert supervisor.status.pid is None
    await supervisor.stop()


async def test_worker_warnings_are_events_and_other_lines_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, exported_model: Path
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), np.zeros((48, 64, 3), np.uint8))
    (folder / "1.png").write_bytes(b"\x89PNG broken")
    caplog.set_level("INFO")
    async with supervised(settings_of(folder, exported_model, **{"source.loop": "false"})) as (
        supervisor,
        recorder,
    ):
        await until(lambda: supervisor.status.state is PerceptionState.FINISHED)
        assert any(level == "warning" and "1.png" in text for level, text in recorder.events)
        assert any(record.name == "vision.detector" for record in caplog.records)


async def test_video_is_finished_at_stop(photos: Path, tmp_path: Path) -> None:
    path = tmp_path / "video" / "flight.webm"
    settings = settings_of(photos, **{"recording.video": str(path)})
    async with supervised(settings) as (supervisor, recorder):
        supervisor.send_hud(("seek car", "height 5.0 m"), "car")
        await until(lambda: len(recorder.results) >= 20)
    assert [level for level, _ in recorder.events] == ["info"]  # a normal end is not reported
    with open_source(str(path), SourceSettings()) as source:
        assert len(list(source)) >= 3


SERVICE = """
import asyncio, sys
from companion.settings.reading import load_settings
from companion.perception.supervisor import PerceptionSupervisor

async def main():
    settings = load_settings("/dev/null", dict(text.split("=", 1) for text in sys.argv[1:]), {})
    supervisor = PerceptionSupervisor(
        settings,
        on_result=lambda _: print("result", "torch" in sys.modules, flush=True),
        on_event=lambda level, text: print("event", text, flush=True),
    )
    await supervisor.start()
    print("pid", supervisor.status.pid, flush=True)
    while supervisor.status.state.value not in ("finished", "failed"):
        await asyncio.sleep(0.05)
    print("state", supervisor.status.state.value, supervisor.status.frames, flush=True)
    await supervisor.stop()

asyncio.run(main())
"""


def service(stdin: int | None, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SERVICE, *arguments], stdin=stdin, stdout=subprocess.PIPE, text=True
    )


def wait_for_line(process: subprocess.Popen[str], beginning: str) -> str:
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(beginning):
            return line.strip()
    raise AssertionError(f"it ended without a line {beginning!r}")


def test_worker_dies_with_a_killed_service_without_torch(photos: Path, exported_model: Path) -> None:
    arguments = [f"source.uri={photos}", "source.loop=true", f"detector.model={exported_model}"]
    arguments += ["detector.runtime=onnxruntime", "detector.image_size=64", "detector.threads=1"]
    with service(subprocess.DEVNULL, *arguments) as process:
        _, pid = wait_for_line(process, "pid").split()
        for _ in range(2):
            assert wait_for_line(process, "result") == "result False"
        assert alive(int(pid))
        process.kill()
    deadline_s = time.monotonic() + DEADLINE_S
    while alive(int(pid)):
        assert time.monotonic() < deadline_s, "the worker outlived its service"
        time.sleep(0.02)


RAW = (
    "source.uri=-",
    "source.pixel_format=bgr24",
    "source.width=64",
    "source.height=48",
    "source.realtime=no",
    "detector.enabled=no",
)


def test_frames_from_the_services_standard_input() -> None:
    ours, theirs = os.pipe()
    with service(ours, *RAW, "source.every_frame=yes") as process:
        os.close(ours)
        with open(theirs, "wb") as writer:
            for number in range(20):
                writer.write(bytes([number]) * (64 * 48 * 3))
        assert wait_for_line(process, "state") == "state finished 20"


def test_file_as_standard_input_is_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "frames.bgr"
    path.write_bytes(bytes(64 * 48 * 3 * 7))
    with path.open("rb") as file, service(file.fileno(), *RAW) as process:
        assert wait_for_line(process, "state") == "state finished 7"


def test_killed_worker_keeps_the_position_in_standard_input() -> None:
    ours, theirs = os.pipe()
    with service(ours, *RAW) as process:
        os.close(ours)
        with open(theirs, "wb") as writer:
            stop = threading.Event()

            def write() -> None:
                while not stop.is_set():
                    writer.write(bytes(64 * 48 * 3))
                    writer.flush()
                    time.sleep(0.005)

            writing = threading.Thread(target=write)
            writing.start()
            try:
                pid = int(wait_for_line(process, "pid").split()[1])
                wait_for_line(process, "result")
                os.kill(pid, signal.SIGKILL)
                wait_for_line(process, "event perception restored")
                wait_for_line(process, "result")
            finally:
                stop.set()
                writing.join()
        assert wait_for_line(process, "state").startswith("state finished")


async def test_supervisor_starts_once_and_stops_repeatedly(photos: Path) -> None:
    supervisor = PerceptionSupervisor(settings_of(photos), on_result=lambda _: None, on_event=lambda *_: None)
    await supervisor.stop()
    await supervisor.start()
    await supervisor.stop()
    await supervisor.stop()
    assert supervisor.status.state is PerceptionState.STOPPED
    with pytest.raises(RuntimeError, match="only once"):
        await supervisor.start()
