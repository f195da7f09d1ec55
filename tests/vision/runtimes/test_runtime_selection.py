"""Selection of a model's runtime by name, and of the fastest by measurement."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import logging
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.vision.runtimes.conftest import make_image, needs
from vision.detections import Detections
from vision.detector import Detector
from vision.exports.export import export
from vision.runtimes import autotune, base, stored_choice
from vision.runtimes.base import RuntimeMissingError, RuntimeName, RuntimeUnusableError, installed
from vision.runtimes.selection import start_runtime
from vision.runtimes.source import read_source, runtime_of_file
from vision.runtimes.stored_choice import cache_folder, forget_choices
from vision.yolo.checkpoint_pair import weights_sha256


def only(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Pretend that only these runtimes are installed."""
    real = importlib.util.find_spec
    absent = set(base.RUNTIMES) - set(names)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in absent else real(name))


@pytest.mark.parametrize(
    ("runtime", "package"),
    [
        ("onnxruntime", "onnxruntime$"),
        ("openvino", r"'mavlink-companion\[models\]'$"),
        ("tensorrt", r"'mavlink-companion\[nvidia\]'$"),
    ],
)
def test_missing_runtime_names_its_extra(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch, runtime: RuntimeName, package: str
) -> None:
    only(monkeypatch, "torch")
    with pytest.raises(RuntimeMissingError, match=rf"pip install {package}"):
        Detector(checkpoint, image_size=96, runtime=runtime)
    with pytest.raises(RuntimeMissingError, match=runtime):
        runtime_of_file(runtime, checkpoint)


def test_missing_runtime_is_not_measured_nor_the_model_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(autotune, "_end_with_parent", lambda parent: None)
    only(monkeypatch, "torch")
    assert autotune.main(json.dumps({"parent_pid": 0, "path": "/none.pt", "runtime": "tensorrt"})) == 0
    assert "mavlink-companion[nvidia]" in capsys.readouterr().out


def test_broken_runtime_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> Any:
        raise ImportError("libsomething.so.1: cannot open shared object file")

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(importlib, "import_module", broken)
    with pytest.raises(RuntimeMissingError, match=r"libsomething"):
        base.required("openvino")


TELEMETRY = """
events = []
class Telemetry:
    def __init__(self, *_, **__): events.append("init")
    def send_event(self, *event): events.append(event)
    def start_session(self, *_): pass
    def end_session(self, *_): pass
    def force_shutdown(self, *_): pass
"""


@pytest.mark.parametrize("imported_before", [False, True])
def test_openvino_does_not_report_its_use(tmp_path: Path, imported_before: bool) -> None:
    needs("openvino")
    package = tmp_path / "openvino_telemetry"
    (package / "backend").mkdir(parents=True)
    (package / "__init__.py").write_text(TELEMETRY)
    (package / "backend" / "__init__.py").write_text("backend_ga4 = None\n")
    program = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        f"if {imported_before}: import openvino\n"
        "from vision.runtimes.base import required\n"
        "before = len(sys.modules['openvino_telemetry'].events) if 'openvino' in sys.modules else 0\n"
        "openvino = required('openvino')\n"
        "try: openvino.convert_model('none.onnx')\n"
        "except Exception: pass\n"
        "import openvino_telemetry\n"
        "print(before, len(openvino_telemetry.events))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert after == before
    assert (before > 0) == imported_before  # of its import, which it reports itself


@pytest.mark.parametrize("stated", [None, "0"])
def test_onnxruntime_is_imported_without_its_telemetry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stated: str | None
) -> None:
    (tmp_path / "onnxruntime.py").write_text(
        "import os\nat_import = os.environ.get('ORT_DISABLE_TELEMETRY')\n"
    )
    program = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from vision.runtimes.base import required\n"
        "print(required('onnxruntime').at_import)"
    )
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
    if stated is not None:
        monkeypatch.setenv("ORT_DISABLE_TELEMETRY", stated)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [stated or "1"]


def test_onnxruntime_is_imported_in_one_place() -> None:
    root = Path(__file__).parents[3]
    direct = [
        path.name
        for package in ("vision", "companion", "mavlink_sim")
        for path in (root / package).rglob("*.py")
        if re.search(r"^\s*(import|from) onnxruntime", path.read_text(), re.MULTILINE)
    ]
    assert direct == ["quantize.py"]  # after `required`


SETTINGS: dict[str, Any] = {"precision": "float32", "image_size": 96, "threads": 1, "confidence": 0.3}


@pytest.fixture(scope="module")
def every(checkpoint: Path) -> Detections:
    return Detector(checkpoint, **SETTINGS).detect(make_image(64, 96))


@pytest.mark.parametrize("runtime", ["onnxruntime", pytest.param("openvino", marks=pytest.mark.slow)])
def test_checkpoint_is_converted_once_for_a_named_runtime(
    checkpoint: Path, every: Detections, runtime: RuntimeName
) -> None:
    needs(runtime, "onnx")
    for classes in (None, ["car", "dog"]) if runtime == "onnxruntime" else (["car", "dog"],):
        reference = every if classes is None else every[np.isin(every.names, classes)]
        assert len(reference)
        detector = Detector(checkpoint, runtime=runtime, classes=classes, **SETTINGS)
        found = detector.detect(make_image(64, 96))
        assert found.names == reference.names
        assert found.confidence == pytest.approx(reference.confidence, abs=1e-3)
        assert found.xyxy == pytest.approx(reference.xyxy, abs=0.05)
    before = {path: path.stat().st_mtime_ns for path in cache_folder().iterdir()}
    Detector(checkpoint, runtime=runtime, classes=classes, **SETTINGS)
    assert {path: path.stat().st_mtime_ns for path in cache_folder().iterdir()} == before


@pytest.fixture(scope="module")
def torchscript(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(checkpoint, "torchscript", tmp_path_factory.mktemp("exported") / "net.torchscript", 64)


def test_runtime_rejects_unsupported_files(torchscript: Path) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"openvino .*\.torchscript"):
        start_runtime(read_source(torchscript), "openvino")


def test_precisions_that_a_runtime_does_not_have_are_rejected(checkpoint: Path, torchscript: Path) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"TorchScript .*float32, .* bfloat16"):
        Detector(torchscript, precision="bfloat16")
    if installed("onnxruntime") and installed("onnx"):  # type: ignore[arg-type]
        with pytest.raises(RuntimeUnusableError, match=r"onnxruntime .*float32, .* float16"):
            Detector(checkpoint, runtime="onnxruntime", precision="float16")


def test_auto_is_torch_if_only_torch_is_installed(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, "torch")
    detector = Detector(checkpoint, image_size=96, runtime="auto", precision="float32")
    assert detector.runtime == "torch"
    assert "only installed" in detector.runtime_reason


class Trial:
    """Replaces the measuring processes: returns values from a table and counts the calls."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, answer: dict[RuntimeName, float | str]) -> None:
        self.answer, self.asked = answer, 0
        monkeypatch.setattr(autotune, "_measure_all", self._measured)
        monkeypatch.setattr(autotune, "version", lambda name: "1.0")

    def _measured(
        self, source: Any, candidates: list[RuntimeName], *_: Any
    ) -> dict[RuntimeName, float | str]:
        self.asked += 1
        return {name: self.answer[name] for name in candidates}


CHOICE: dict[str, Any] = {"class_ids": None, "precision": "auto", "threads": None, "image_size": 96}


@pytest.mark.parametrize(
    ("answer", "best"),
    [
        pytest.param({"torch": 50.0, "openvino": 30.0, "onnxruntime": 40.0}, "openvino", id="the fastest"),
        pytest.param({"torch": 50.0, "openvino": 49.0}, "torch", id="torch where it hardly matters"),
        pytest.param({"torch": 50.0, "openvino": "illegal instruction"}, "torch", id="one that breaks"),
    ],
)
def test_auto_selects_the_fastest_with_a_reason(
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    answer: dict[RuntimeName, Any],
    best: str,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    asked = Trial(monkeypatch, answer)
    caplog.set_level(logging.INFO)
    source = read_source(checkpoint)
    name, reason = autotune.fastest_runtime(source, list(answer), **CHOICE)
    assert name == best
    assert reason.startswith("measured now: ")
    assert all(f"{key} {value:.1f} ms" in reason for key, value in answer.items() if value != str(value))
    assert f"runtime auto: {best}" in caplog.text
    again = autotune.fastest_runtime(source, list(answer), **CHOICE)
    # A failed runtime may work next time, so it is measured again.
    failed = any(isinstance(value, str) for value in answer.values())
    assert again == (best, reason if failed else reason.replace("measured now", "measured before"))
    assert asked.asked == (2 if failed else 1)


def test_choice_is_remeasured_when_its_inputs_change(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    asked = Trial(monkeypatch, {"torch": 2.0, "openvino": 1.0})
    source = read_source(checkpoint)
    names: list[RuntimeName] = ["torch", "openvino"]
    autotune.fastest_runtime(source, names, **CHOICE)
    autotune.fastest_runtime(source, names, **CHOICE | {"image_size": 128})
    autotune.fastest_runtime(source, names, **CHOICE | {"threads": 1})
    monkeypatch.setattr(autotune, "version", lambda name: "2.0")
    autotune.fastest_runtime(source, names, **CHOICE)
    monkeypatch.setattr(stored_choice, "board", lambda: ["another"])
    autotune.fastest_runtime(source, names, **CHOICE)
    assert asked.asked == 5
    for kept in cache_folder().glob("trial-*.json"):
        kept.write_text(json.dumps({"question": {}, "answer": []}))
    autotune.fastest_runtime(source, names, **CHOICE)
    assert asked.asked == 6
    assert forget_choices("another-model") == 0
    assert forget_choices(weights_sha256(checkpoint)) == 1
    autotune.fastest_runtime(source, names, **CHOICE)
    assert asked.asked == 7


def test_uncacheable_choice_is_still_used(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    Trial(monkeypatch, {"torch": 2.0, "openvino": 1.0})
    name, _ = autotune.fastest_runtime(read_source(checkpoint), ["torch", "openvino"], **CHOICE)
    assert name == "openvino"
    assert "cannot be stored" in caplog.text
    assert f"{tmp_path / 'file'}" in caplog.text


def test_error_lists_every_runtimes_reason(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    Trial(monkeypatch, {"openvino": "6", "onnxruntime": "7"})
    with pytest.raises(RuntimeUnusableError, match="openvino: 6; onnxruntime: 7"):
        autotune.fastest_runtime(read_source(checkpoint), ["openvino", "onnxruntime"], **CHOICE)


def test_measurement_runs_in_a_subprocess(checkpoint: Path) -> None:
    source = read_source(checkpoint)
    answer = autotune._measure_all(source, ["torch", "tensorrt"], [1, 2], "float32", 1, 64)
    assert isinstance(answer["torch"], float)
    assert answer["torch"] > 0
    if not installed("tensorrt"):
        assert "mavlink-companion[nvidia]" in answer["tensorrt"]


def test_version_of_a_runtime_from_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def of_package(name: str) -> str:
        if name == "onnxruntime":
            raise importlib.metadata.PackageNotFoundError(name)
        return "1.2.3"

    monkeypatch.setattr(importlib.metadata, "version", of_package)
    monkeypatch.setattr(
        importlib.metadata, "packages_distributions", lambda: {"onnxruntime": ["onnxruntime-gpu"]}
    )
    assert base.version("onnxruntime") == "1.2.3"
    monkeypatch.setattr(importlib.metadata, "packages_distributions", dict)
    assert base.version("onnxruntime") == "unknown"
