"""TensorRT without a GPU: missing or invalid parts are named in the error."""

from __future__ import annotations

from pathlib import Path

import pytest

from vision.runtimes.base import RuntimeMissingError, RuntimeUnusableError, installed
from vision.runtimes.exported import ExportedFacts, with_facts
from vision.runtimes.source import read_source
from vision.runtimes.tensorrt_build import build_plan
from vision.runtimes.tensorrt_runtime import TensorRtRuntime

FACTS = ExportedFacts(("person",), (8, 16, 32), 16, False, 640, "00")
absent = pytest.mark.skipif(installed("tensorrt"), reason="TensorRT is installed here")


@pytest.fixture
def engine(tmp_path: Path) -> Path:
    path = tmp_path / "net.engine"
    path.write_bytes(with_facts(FACTS, b"a plan"))
    return path


@absent
def test_running_without_tensorrt_names_the_extra(engine: Path) -> None:
    with pytest.raises(RuntimeMissingError, match=r"mavlink-companion\[tensorrt\]"):
        TensorRtRuntime(engine)


@absent
def test_building_without_tensorrt_names_the_extra(tmp_path: Path) -> None:
    with pytest.raises(RuntimeMissingError, match=r"mavlink-companion\[tensorrt\]"):
        build_plan(tmp_path / "net.onnx", largest_side=640, stride=32)


def test_plan_metadata_is_readable_without_tensorrt(engine: Path) -> None:
    source = read_source(engine)
    assert source.class_names == ("person",)
    assert source.runners() == ("tensorrt",)


def test_a_precision_that_a_plan_does_not_have_is_rejected(engine: Path) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"float16.* bfloat16"):
        TensorRtRuntime(engine, precision="bfloat16")


def test_missing_plan_is_a_one_line_error(tmp_path: Path) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"none\.engine: no such file"):
        read_source(tmp_path / "none.engine")
