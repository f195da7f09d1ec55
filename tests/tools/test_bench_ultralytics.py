"""The comparison with Ultralytics: its ratios. The measurement itself needs an environment with it."""

from __future__ import annotations

from tools.bench_ultralytics import ratios


def test_ratios_of_time_and_of_processor_time() -> None:
    rows = [
        {"runtime": "ultralytics as-installed", "p50_ms": 100.0, "processor_ms": 80.0},
        {"runtime": "torch", "p50_ms": 50.0, "processor_ms": 60.0},
        {"runtime": "openvino", "p50_ms": 25.0, "processor_ms": 40.0},
    ]
    assert [line.split(":")[0] for line in ratios(rows)] == ["torch", "openvino"]
    for line, (wall, processor) in zip(ratios(rows), (("0.50", "0.75"), ("0.25", "0.50")), strict=True):
        words = line.split()
        assert [words[1], words[6]] == [wall, processor]
        assert line.endswith("ultralytics as-installed")
