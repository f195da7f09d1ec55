"""What `companion bench latency` makes of the stamps that a result and its setpoint carry."""

from __future__ import annotations

import pytest

from companion.bench.latency import _Figures
from vision.detections import Detections
from vision.pipeline import PerceptionResult


def test_stages_add_up_to_the_latency_without_the_network() -> None:
    stages_ms = {"capture": 12.0, "decode": 0.5, "wait": 0.25, "preprocess": 0.125, "inference": 9.0}
    known_ms = sum(stages_ms.values())
    timing_ms = {**stages_ms, "total": 9.5}
    captured_ns = 7_000_000_000
    result = PerceptionResult(
        3, captured_ns, captured_ns + round(known_ms * 1e6), 64, 48, Detections.empty(("car",)), timing_ms, 0
    )
    figures = _Figures()
    figures.take(result, result.inferred_ns + 1_500_000, result.inferred_ns + 2_000_000)
    (latency_ms,), (beyond_ms,) = figures.latency_ms, figures.beyond_ms
    assert latency_ms == pytest.approx(known_ms + 2.0)
    assert beyond_ms == pytest.approx(latency_ms - 12.0 - 9.0)
    assert figures.stages_ms["deliver"] == pytest.approx([1.5])
    assert figures.stages_ms["steer"] == pytest.approx([0.5])
    assert sum(times[0] for times in figures.stages_ms.values()) == pytest.approx(latency_ms)
    figures.clear()
    assert not figures.latency_ms + figures.beyond_ms + list(figures.stages_ms)
