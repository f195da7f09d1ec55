"""The benchmark of the bus: what it counts and that nothing is lost on a recovered topic."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.bus import _LOADING_S, _START_S, _detections, main, measure_bus, measure_recovery
from companion.host.scheduling import DEFAULT_NS, set_scheduler_slice
from companion.perception.process import PerceptionProcess
from companion.settings import Settings
from tests.companion.bus.message_check import check_message

pytestmark = pytest.mark.realtime


# More than the command's own limits: its workers, its subscriber's process, its subscription.
@pytest.mark.timeout(_LOADING_S + 3 * _START_S)
def test_delay_to_another_process_is_measured(
    exported_model: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spawn = PerceptionProcess.spawn

    async def spawn_with_one_hertz(settings: Settings, standard_input: int) -> PerceptionProcess:
        """A paced source would give one frame a second, also on a busy machine. A small model starts soon."""
        source = settings.source.model_copy(update={"rate_hz": 1.0})
        small = {"model": str(exported_model), "runtime": "onnxruntime", "image_size": 160}
        detector = settings.detector.model_copy(update=small)
        changed = settings.model_copy(update={"source": source, "detector": detector})
        return await spawn(changed, standard_input)

    monkeypatch.setattr(PerceptionProcess, "spawn", spawn_with_one_hertz)
    monkeypatch.setattr(sys, "argv", ["bus", "--seconds", "1", "--rate-hz", "1000", "--load", "1"])
    try:
        main()
    finally:
        set_scheduler_slice(DEFAULT_NS)
    figures = json.loads(capsys.readouterr().out)
    assert figures["published"] == 1000
    assert 0 < figures["received"] <= 1000
    # Some messages are late, and the next ones with them.
    assert 0.0 < figures["rate_hz"] < 1000.0
    assert figures["message_bytes"] > 4000
    assert figures["detectors"] == 1
    assert figures["detector_frames_per_s"] > 2.0
    assert figures["build_and_encode_p50_ms"] > 0.0
    p50, p99, largest = (figures[f"put_to_subscriber_{name}_ms"] for name in ("p50", "p99", "max"))
    assert 0.0 < p50 <= p99 <= largest


def test_worker_ends_if_the_next_one_cannot_start(monkeypatch: pytest.MonkeyPatch) -> None:
    spawn = PerceptionProcess.spawn
    started: list[PerceptionProcess] = []

    async def spawn_one(*arguments: Any) -> PerceptionProcess:
        if started:
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        started.append(await spawn(*arguments))
        return started[0]

    monkeypatch.setattr(PerceptionProcess, "spawn", spawn_one)
    with pytest.raises(BlockingIOError):
        measure_bus(1.0, rate_hz=30.0, load=2)
    with pytest.raises(ProcessLookupError):
        os.kill(started[0].pid, 0)


def test_subscriber_that_does_not_start_ends_the_command() -> None:
    """The process ends, with one line: no thread of an open session keeps it."""
    program = "from benchmarks import bus; bus._START_S = 0.001; bus.main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "--load", "0"],
        cwd=Path(__file__).parents[3],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "0.001 s" in done.stderr


def test_benchmark_publishes_a_valid_message() -> None:
    check_message("detections", _detections(1))


def test_no_message_of_a_recovered_topic_is_lost() -> None:
    figures = measure_recovery(5_000)
    assert (figures["received"], figures["lost"]) == (5_000, 0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_million_messages_of_a_recovered_topic_leave_no_memory() -> None:
    figures = measure_recovery(1_000_000)
    assert figures["lost"] == 0
    # A message is 45 bytes: kept ones would be 45 MB.
    assert figures["publisher_growth_kb"] < 5_000
    assert figures["subscriber_growth_kb"] < 5_000
