"""Measuring the detector: real processes, on a network small enough for it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from companion.bench.detector import measure_detectors, table
from companion.cli import app


def bench(model: Path, *more: str) -> str:
    arguments = ["bench", "detector", "--model", str(model), "--runtime", "onnxruntime"]
    arguments += ["--frame", "64x48", "--frames", "6", "--threads", "1", *more]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    return result.output


def test_measurement_has_all_figures_and_can_be_compared(
    exported_model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []

    def measure(*arguments: Any, **options: Any) -> dict[str, Any]:
        results.append(measure_detectors(*arguments, **options))
        return results[-1]

    monkeypatch.setattr("companion.bench.detector.measure_detectors", measure)
    heading, line = bench(exported_model, "--classes", "car").splitlines()
    (earlier,) = results
    (row,) = earlier["rows"]
    names = [
        "runtime", "precision", "threads", "fastest_ms", "p50_ms", "p99_ms", "around_p50_ms", "processor_ms",
        "frames_per_s", "memory_mb", "first_detection_s",
    ]  # fmt: skip
    assert heading.split() == names
    assert line.split() == [str(row[name]) for name in names]
    assert (row["runtime"], row["threads"], row["frames"]) == ("onnxruntime", 1, 6)
    assert earlier["classes"] == ["car"]
    assert earlier["frame"] == "64x48"
    assert 0 < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
    assert 0 < row["around_p50_ms"] < row["p50_ms"] + row["max_ms"]
    assert row["frames_per_s"] > 0
    assert row["processor_ms"] > 0
    assert row["memory_mb"] > 10
    assert row["first_detection_s"] > 0
    monkeypatch.setattr("companion.bench.detector.measure_detectors", lambda *_, **__: earlier)
    (tmp_path / "earlier.json").write_text(bench(exported_model, "--json"))
    assert json.loads((tmp_path / "earlier.json").read_text()) == earlier
    later = earlier | {"rows": [row | {"p50_ms": 2 * row["p50_ms"]}]}
    monkeypatch.setattr("companion.bench.detector.measure_detectors", lambda *_, **__: later)
    _, line = bench(exported_model, "--against", str(tmp_path / "earlier.json")).splitlines()
    assert f" {row['p50_ms']} ms: 2.00 " in line


def test_what_was_not_measured_before_says_so() -> None:
    names = (
        "runtime",
        "precision",
        "threads",
        "fastest_ms",
        "p50_ms",
        "p99_ms",
        "around_p50_ms",
        "processor_ms",
        "frames_per_s",
    )
    row = dict.fromkeys([*names, "memory_mb", "first_detection_s"], 1)
    assert table({"rows": [row]}, {"rows": []})[1].endswith("not measured before")


def test_exported_file_is_measured_on_the_runtimes_that_run_it(
    small_model: Path, exported_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def measure(model: str, *, runtimes: list[str], **_: Any) -> dict[str, Any]:
        asked.append(list(runtimes))
        return {"rows": []}

    monkeypatch.setattr("companion.bench.detector.measure_detectors", measure)
    monkeypatch.setattr("vision.runtimes.base.installed", lambda _: True)
    for model in (small_model, exported_model):
        assert CliRunner().invoke(app, ["bench", "detector", "--model", str(model), "--json"]).exit_code == 0
    assert asked == [["torch", "onnxruntime", "openvino", "tensorrt"], ["onnxruntime", "openvino"]]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--model", "none.pt"], "none.pt"),
        (["--runtime", "abacus"], "'abacus'"),
        (["--frame", "big"], "WIDTHxHEIGHT"),
        (["--classes", "zebra"], "unknown class 'zebra'"),
    ],
)
def test_what_cannot_be_measured_is_exit_code_2(
    exported_model: Path, arguments: list[str], expected: str
) -> None:
    common = [
        "bench",
        "detector",
        "--model",
        str(exported_model),
        "--runtime",
        "onnxruntime",
        "--frames",
        "5",
    ]
    common += ["--frame", "64x48"]
    result = CliRunner().invoke(app, [*common, *arguments])
    assert result.exit_code == 2
    assert expected in result.output
