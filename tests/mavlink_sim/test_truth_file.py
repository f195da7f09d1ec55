"""The truth file on a full disk."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mavlink_sim.testing import running_simulator
from mavlink_sim.world.truth_file import TruthFile

pytestmark = pytest.mark.realtime

FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")


def test_each_line_is_flushed(tmp_path: Path) -> None:
    file = TruthFile(tmp_path / "truth.jsonl")
    assert file.write(json.dumps({"a": 1})) is None
    assert (tmp_path / "truth.jsonl").read_text() == '{"a": 1}\n'
    file.close()
    file.close()
    assert file.write("more") is None


@needs_full
def test_full_disk_reported_once_and_ends_file() -> None:
    file = TruthFile(FULL)
    assert "/dev/full: No space left on device" in (file.write("line") or "")
    assert file.write("line") is None


@needs_full
def test_vehicle_continues_after_truth_write_error() -> None:
    with running_simulator(truth=FULL) as simulator:
        simulator.wait_for_event("/dev/full: No space left on device")
        assert simulator.process.poll() is None
