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
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.host.scheduling import DEFAULT_NS, SHORTEST_NS, set_scheduler_slice
from companion.perception.standard_input import StandardInput
from companion.perception.supervisor import PerceptionStartError, PerceptionState, PerceptionSupervisor
from companion.perception.worker import NICENESS
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
    async with supervised(settings_of(photos, **{"detector.rate_hz": "10"})) as (supervisor, recorder):
        await until(lambda: len(recorder.results) >= 4)
        dropped = supervisor.status.dropped
        gaps = np.diff([result.sequence for result in recorder.results])
        assert gaps.min() >= 4  # of the source's 50 Hz; jitter
        assert gaps.sum() <= 5 * len(gaps) + 1 + dropped
        assert all(len(result.detections) == 0 for result in recorder.results)
        assert supervisor.class_names == ()
        answer = await supervisor.select(SelectRequest((0.25, 0.25, 0.5, 0.5)))
        assert not answer.success
        assert "detector.enabled " in answer.reason
        assert "tracker.enabled " in answer.reason
        await supervisor.stop()  # and once more by `supervised`
    with pytest.raises(RuntimeError, match="only once"):
        await supervisor.start()


async def test_start_failure_is_one_line(photos: Path) -> None:
    supervisor = PerceptionSupervisor(
        settings_of("/nowhere/street.mp4"), on_result=lambda _: None, on_event=lambda *_: None
    )
    with pytest.raises(PerceptionStartError) as caught:
        await supervisor.start()
    assert "/nowhere/street.mp4: " in str(caught.value)
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
        pid = supervisor.status.pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)  # it dies before it answers
        asked = asyncio.create_task(supervisor.select(SelectRequest(None)))
        await asyncio.sleep(0)
        os.kill(pid, signal.SIGKILL)
        answer = await asked
        assert not answer.success
        assert "has ended" in answer.reason
    stopped = await supervisor.select(SelectRequest(None))
    assert not stopped.success
    assert "not running (stopped)" in stopped.reason


async def test_killed_worker_is_replaced_and_sequence_continues(photos: Path, tmp_path: Path) -> None:
    video = tmp_path / "video" / "flight.webm"
    async with supervised(settings_of(photos, **{"recording.video": str(video)})) as (supervisor, recorder):
        supervisor.send_hud(("seek car", "height 5.0 m"), "car")
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
        await until(lambda: len(recorder.results) >= before + 20)
        assert recorder.has_event(f"process {pid} was killed", "SIGKILL; ", "restarting (1 of 5)")
        assert recorder.has_event("perception restored")
        assert supervisor.status.restarts == 1
        assert supervisor.status.pid not in (None, pid)
        sequences = [result.sequence for result in recorder.results]
        assert sequences == sorted(set(sequences))
        events = len(recorder.events)
    assert len(recorder.events) == events  # a normal end is not reported
    # The new worker does not overwrite the video, and its own has an end.
    assert video.exists()
    with open_source(str(video.with_stem("flight-2")), SourceSettings()) as source:
        assert len(list(source)) >= 3


async def test_stopped_worker_is_stuck_and_replaced(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with supervised(settings_of(photos)) as (supervisor, recorder):
        await until(lambda: len(recorder.results) >= 3)
        pid = supervisor.status.pid
        assert pid is not None
        monkeypatch.setattr("os.getloadavg", lambda: (987.0, 0.0, 0.0))
        os.kill(pid, signal.SIGSTOP)
        await until(lambda: recorder.has_event(f"process {pid} is stuck"))
        assert not alive(pid)
        before = len(recorder.results)
        assert "is stuck" in supervisor.status.problem
        assert "load 987" in supervisor.status.problem
        await until(lambda: len(recorder.results) > before)
        assert supervisor.status.state is PerceptionState.RUNNING
        assert supervisor.status.problem == ""


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


async def test_idle_priority_and_a_death_during_stop(photos: Path) -> None:
    async with supervised(settings_of(photos, **{"detector.priority": "idle"})) as (supervisor, recorder):
        pid = supervisor.status.pid
        assert pid is not None
        # Not until it has results: beside other tests it may get almost no time.
        await until(lambda: os.sched_getscheduler(pid) == os.SCHED_IDLE)
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
    await supervisor.stop()  # before a start it does nothing
    starting = asyncio.create_task(supervisor.start())
    await until(lambda: supervisor.status.pid is not None)
    pid = supervisor.status.pid
    assert pid is not None
    starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting
    assert not alive(pid)


async def test_failing_callback_is_reported(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.host.restarts.SOON_S", (0.2, 0.2))
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
        assert recorder.events[-1][0] == "info"
        assert "of stream" in recorder.events[-1][1]
        assert supervisor.status.restarts == 0
        assert supervisor.status.frames + supervisor.status.dropped == 1


SERVICE = """
import asyncio, sys
from companion.settings.reading import load_settings
from companion.perception.supervisor import PerceptionSupervisor

async def main():
    settings = load_settings("/dev/null", dict(text.split("=", 1) for text in sys.argv[1:]), {})
    supervisor = PerceptionSupervisor(
        settings,
        on_result=lambda _: print("result", "torch" in sys.modules, flush=True),
        on_event=lambda level, text: None,
    )
    await supervisor.start()
    print("pid", supervisor.status.pid, flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""


def test_worker_dies_with_a_killed_service_without_torch(photos: Path, exported_model: Path) -> None:
    arguments = [f"source.uri={photos}", "source.loop=true", f"detector.model={exported_model}"]
    arguments += ["detector.runtime=onnxruntime", "detector.image_size=64", "detector.threads=1"]
    command = [sys.executable, "-c", SERVICE, *arguments]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            first, *results = (process.stdout.readline().split() for _ in range(3))
            assert first[0] == "pid"
            assert results == [["result", "False"]] * 2
            assert alive(int(first[1]))
        finally:
            process.kill()
    deadline_s = time.monotonic() + DEADLINE_S
    while alive(int(first[1])):
        assert time.monotonic() < deadline_s, "the worker outlived its service"
        time.sleep(0.02)


FRAME = bytes(64 * 48 * 3)


def raw_settings(descriptor: int, patch: pytest.MonkeyPatch, **overrides: str) -> Settings:
    """Raw frames from a descriptor in place of standard input; the service itself reads descriptor 0 in
    `test_mavsdk_flight_with_frames_on_standard_input`."""
    patch.setattr(
        "companion.perception.supervisor.StandardInput", partial(StandardInput, descriptor=descriptor)
    )
    values = {"source.uri": "-", "source.pixel_format": "bgr24", "source.width": "64", "source.height": "48"}
    values |= {"detector.enabled": "no", **overrides}
    return load_settings(os.devnull, values, {})


@contextmanager
def writing(frames: Iterable[bytes]) -> Iterator[int]:
    """A pipe into which a thread writes the frames; yields the end that is read."""
    reading, target = os.pipe()

    def write() -> None:
        # A test that fails stops reading.
        with suppress(BrokenPipeError), open(target, "wb", buffering=0) as writer:
            for data in frames:
                writer.write(data)

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    try:
        yield reading
    finally:
        os.close(reading)
        thread.join(DEADLINE_S)


async def test_frames_from_a_pipe_are_all_read(monkeypatch: pytest.MonkeyPatch) -> None:
    with writing([FRAME] * 20) as pipe:
        settings = raw_settings(pipe, monkeypatch, **{"source.every_frame": "yes"})
        async with supervised(settings) as (supervisor, _):
            await until(lambda: supervisor.state is PerceptionState.FINISHED)
            assert supervisor.status.frames == 20


async def test_file_as_standard_input_is_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "frames.bgr"
    path.write_bytes(FRAME * 7)
    with path.open("rb") as file:
        settings = raw_settings(file.fileno(), monkeypatch, **{"source.every_frame": "yes"})
        async with supervised(settings) as (supervisor, _):
            await until(lambda: supervisor.state is PerceptionState.FINISHED)
            assert supervisor.status.frames == 7


async def test_killed_worker_keeps_the_position_in_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()

    def frames() -> Iterator[bytes]:
        while not ended.wait(0.005):
            yield FRAME

    with writing(frames()) as pipe:
        try:
            async with supervised(raw_settings(pipe, monkeypatch)) as (supervisor, recorder):
                await until(lambda: recorder.results)
                pid = supervisor.status.pid
                assert pid is not None
                os.kill(pid, signal.SIGKILL)
                await until(lambda: recorder.has_event("perception restored"))
                before = len(recorder.results)
                await until(lambda: len(recorder.results) > before)
                ended.set()
                await until(lambda: supervisor.state is PerceptionState.FINISHED)
        finally:
            ended.set()


async def test_worker_ended_by_another_program_is_replaced(photos: Path) -> None:
    async with supervised(settings_of(photos)) as (supervisor, recorder):
        await until(lambda: recorder.results)
        first = supervisor.status.pid
        assert first is not None
        os.kill(first, signal.SIGTERM)  # as `kill`, or the kernel's memory guard
        await until(lambda: supervisor.status.pid not in (None, first))
        await until(lambda: supervisor.state is PerceptionState.RUNNING)
        assert supervisor.problem == ""
        assert recorder.has_event("lost", "signal")


async def test_input_that_ends_before_a_frame_ends_perception_only(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writer = os.pipe()
    settings = raw_settings(reading, monkeypatch)
    os.close(writer)  # as by a program that has failed at its start
    async with supervised(settings) as (supervisor, recorder):
        await until(lambda: supervisor.state is PerceptionState.FAILED)
        assert "first frame" in supervisor.problem
        assert (supervisor.next_try_ns, supervisor.status.restarts) == (None, 0)
        assert [level for level, _ in recorder.events] == ["error"]
    os.close(reading)
