"""`companion bench bus`: what it counts and that nothing is lost on a recovered topic."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.bench.bus import _detections, measure_recovery
from tests.companion.bus.message_check import check_message
from tests.companion.command_line import companion

pytestmark = pytest.mark.realtime


def test_delay_to_another_process_is_measured(tmp_path: Path) -> None:
    command = ("bench", "bus", "--seconds", "1", "--load", "1", "--json")
    printed = companion(*command, cwd=tmp_path, timeout_s=120.0)
    assert printed.returncode == 0, printed.stderr
    figures = json.loads(printed.stdout)
    assert figures["published"] == 30
    assert 0 < figures["received"] <= 30
    assert figures["message_bytes"] > 4000
    assert figures["detectors"] == 1
    assert figures["detector_frames_per_s"] > 0.0
    assert figures["build_and_encode_p50_ms"] > 0.0
    p50, p99, largest = (figures[f"put_to_subscriber_{name}_ms"] for name in ("p50", "p99", "max"))
    assert 0.0 < p50 <= p99 <= largest


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
