"""Tracks from the worker to the service, and attitudes from the service to the worker."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.perception.messages import Attitude, Ended, Hud, Report, ResultSender, packed, receive
from companion.perception.status import LiveTracks
from companion.perception.supervisor import PerceptionState, PerceptionSupervisor
from companion.perception.worker import ControlChannel
from companion.settings import Settings
from companion.settings.reading import load_settings
from vision.attitude import quaternion_from_euler
from vision.detections import NO_TRACK, Detections
from vision.pipeline import PerceptionResult
from vision.rotation import matrix_from_euler
from vision.tracking import Track, TrackEvent, TrackEventKind, TrackState

pytestmark = pytest.mark.realtime

NEW, UPDATE, LOST, END = (
    TrackEventKind.NEW,
    TrackEventKind.UPDATE,
    TrackEventKind.LOST,
    TrackEventKind.END,
)
DEADLINE_S = 60.0


def event(kind: TrackEventKind, track_id: int, stamp_ns: int = 0) -> TrackEvent:
    track = Track(track_id, 0, "car", TrackState.CONFIRMED, (0.0, 0.0, 1.0, 1.0), 0.9, 0.8, 3, 0, stamp_ns)
    return TrackEvent(kind, stamp_ns, track)


def result(sequence: int, *events: TrackEvent, ids: tuple[int, ...] = ()) -> PerceptionResult:
    detections = Detections(
        np.zeros((len(ids), 4), np.float32),
        np.zeros(len(ids), np.float32),
        np.zeros(len(ids), np.int64),
        ("car",),
        track_id=np.array(ids, np.int64),
        track_score=np.zeros(len(ids), np.float32),
        track_confirmed=np.zeros(len(ids), np.bool_),
    )
    return PerceptionResult(sequence, sequence * 1000, 0, 64, 48, detections, {}, 0, events)


def ids_in(result: PerceptionResult) -> list[int]:
    assert result.detections.track_id is not None
    ids: list[int] = result.detections.track_id.tolist()
    return ids


def kinds(result: PerceptionResult) -> list[tuple[TrackEventKind, int]]:
    return [(event.kind, event.track.track_id) for event in result.track_events]


def test_tracks_of_a_dead_worker_end() -> None:
    tracks = LiveTracks()
    tracks.update(result(1, event(NEW, 1), event(NEW, 2), event(NEW, 3)))
    tracks.update(result(2, event(UPDATE, 1), event(LOST, 2), event(END, 3)))
    assert len(tracks) == 2
    tracks.worker_ended()
    assert len(tracks) == 0
    first = tracks.update(result(9, event(NEW, 4)))
    assert kinds(first) == [(END, 1), (END, 2), (NEW, 4)]
    assert [event.stamp_ns for event in first.track_events[:2]] == [9000, 9000]
    assert kinds(tracks.update(result(10))) == []


def test_tracks_end_once_after_two_dead_workers() -> None:
    tracks = LiveTracks()
    tracks.update(result(1, event(NEW, 1)))
    tracks.worker_ended()
    tracks.worker_ended()
    assert kinds(tracks.update(result(2))) == [(END, 1)]


def test_next_worker_has_new_track_ids() -> None:
    tracks = LiveTracks()
    assert tracks.next_id == 1
    tracks.update(result(1, ids=(NO_TRACK, 12, 5)))
    assert tracks.next_id == 13
    tracks.update(result(2, event(NEW, 30)))
    tracks.update(result(3, event(END, 30), ids=(4,)))
    assert tracks.next_id == 31


def test_events_of_a_replaced_result_are_merged() -> None:
    ours, theirs = socket.socketpair()
    ours.settimeout(30)
    with ours, theirs:
        sender = ResultSender(theirs, on_lost=lambda: None)
        # Larger than the socket's buffer, so that everything after it waits.
        filler = Detections.empty(tuple(f"{number:01000}" for number in range(2000)))
        sender.put_newest(Report(PerceptionResult(0, 0, 0, 64, 48, filler, {}, 0), 1, 0))
        sender.put_newest(Report(result(1, event(NEW, 1), event(UPDATE, 2)), 2, 0))
        sender.put_newest(Report(result(2, event(UPDATE, 1), event(LOST, 2)), 3, 0))
        sender.put_newest(Report(result(3, event(UPDATE, 1), event(END, 2)), 4, 0))
        closing = threading.Thread(target=sender.close, args=(Ended(True, "done", 4), 30.0))
        closing.start()
        first, second = receive(ours), receive(ours)
        closing.join()
    assert isinstance(first, Report)
    assert isinstance(second, Report)
    assert second.replaced == 2
    assert kinds(second.result) == [(NEW, 1), (LOST, 2), (UPDATE, 1), (END, 2)]


def test_worker_receives_attitudes() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        control = ControlChannel(theirs)
        for step in range(6):
            ours.sendall(packed(Attitude(step * 20_000_000, quaternion_from_euler(0, 0, 0.1 * step))))
        ours.sendall(packed(Hud(("flying",), None)))
        deadline_s = time.monotonic() + DEADLINE_S
        while control.hud.lines != ("flying",):
            assert time.monotonic() < deadline_s
            time.sleep(0.001)
        attitude = control.telemetry.attitudes.at(50_000_000)
        control.finished()
    assert attitude is not None
    np.testing.assert_allclose(attitude, matrix_from_euler(0, 0, 0.25), atol=1e-5)


# --- with real workers


@pytest.fixture
def settings(tmp_path: Path, exported_model: Path) -> Settings:
    """A still image, in which an untrained network gives the same detections in every frame."""
    folder = tmp_path / "photos"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), np.full((48, 64, 3), 90, np.uint8))
    values = {
        "source.uri": str(folder),
        "source.loop": "true",
        "source.rate_hz": "20",
        "detector.model": str(exported_model),
        "detector.runtime": "onnxruntime",
        "detector.image_size": "64",
        "detector.threads": "1",
        "detector.precision": "float32",
        "detector.confidence": "0",
        "tracker.confirm_score": "0",
        "tracker.max_age_s": "600",
    }
    return load_settings(os.devnull, values, {})


async def until(condition: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s, "timeout"
        await asyncio.sleep(0.01)


async def test_worker_tracks_by_attitude_and_restarts_with_new_ids(
    settings: Settings,
) -> None:
    results: list[PerceptionResult] = []
    supervisor = PerceptionSupervisor(settings, on_result=results.append, on_event=lambda *_: None)

    def ids_of(kind: TrackEventKind) -> list[int]:
        return [e.track.track_id for r in results for e in r.track_events if e.kind is kind]

    def spun() -> bool:
        """Send attitudes that alternate by 143 degrees, so that no object stays in view between frames."""
        now_ns = time.monotonic_ns()
        yaw_rad = 2.5 * (now_ns // 500_000_000 % 2)
        supervisor.send_attitude(now_ns, quaternion_from_euler(0.0, 0.0, yaw_rad))
        return bool(ids_of(END))

    await supervisor.start()
    try:
        await until(lambda: len(results) >= 5)
        assert ids_of(NEW)
        assert ids_of(END) == []
        assert supervisor.status.tracks == len(ids_of(NEW))
        assert results[-1].timing_ms["track"] > 0
        assert set(ids_in(results[-1])) >= set(ids_of(NEW))

        await until(spun)

        pid = supervisor.status.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        await until(lambda: supervisor.status.state is PerceptionState.RESTARTING)
        before, live = len(results), set(ids_of(NEW)) - set(ids_of(END))
        await until(lambda: len(results) > before + 3)
        after = results[before:]
        ends = [e.track.track_id for e in after[0].track_events if e.kind is END]
        assert sorted(ends) == sorted(live)
        newer = [number for r in after for number in ids_in(r) if number != NO_TRACK]
        assert min(newer) > max(number for r in results[:before] for number in ids_in(r))
    finally:
        await supervisor.stop()


class AttitudeRecorder:
    """Replaces the process and records the stamps of the attitudes."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []

    def send_attitude(self, attitude: Attitude) -> None:
        self.stamps_ns.append(attitude.stamp_ns)


def supervisor_with(recorder: AttitudeRecorder, **overrides: str) -> PerceptionSupervisor:
    settings = load_settings(os.devnull, overrides, {})
    supervisor = PerceptionSupervisor(settings, on_result=lambda _: None, on_event=lambda *_: None)
    supervisor._process = recorder  # type: ignore[assignment]
    return supervisor


@pytest.mark.parametrize("rate_hz", [30, 50, 77, 250])
def test_attitudes_are_limited_to_fifty_a_second(rate_hz: int) -> None:
    recorder = AttitudeRecorder()
    supervisor = supervisor_with(recorder)
    rng = np.random.default_rng(rate_hz)
    for step in range(4 * rate_hz):
        stamp_ns = round((1.0 + step / rate_hz + rng.uniform(0, 0.2) / rate_hz) * 1e9)
        for _ in range(2):  # other telemetry repeats the same attitude
            supervisor.send_attitude(stamp_ns, (1.0, 0.0, 0.0, 0.0))
    assert (np.diff(recorder.stamps_ns) > 0).all()
    assert 0.85 * 4 * min(rate_hz, 50) <= len(recorder.stamps_ns) <= 4 * min(rate_hz, 50) + 2


@pytest.mark.parametrize(
    ("detector", "obstacles", "wanted"),
    [("false", "off", False), ("false", "auto", True), ("true", "off", True), ("true", "auto", True)],
)
def test_attitude_is_sent_only_if_needed(detector: str, obstacles: str, wanted: bool) -> None:
    recorder = AttitudeRecorder()
    supervisor = supervisor_with(recorder, **{"detector.enabled": detector, "guidance.obstacles": obstacles})
    supervisor.send_attitude(1, (1.0, 0.0, 0.0, 0.0))
    assert recorder.stamps_ns == ([1] if wanted else [])
