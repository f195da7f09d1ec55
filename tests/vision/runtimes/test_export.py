"""Exported networks: same outputs as torch, loadable alone with their metadata, rejected if invalid."""

from __future__ import annotations

import ctypes
import enum
import hashlib
import importlib.util
import json
import re
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.datasets.training_scenes import random_scene
from tests.vision.runtimes.conftest import NAMES, make_image, needs
from vision.detector import Detector, class_names_of
from vision.exports.export import export
from vision.extras import install_command
from vision.runtimes import conversion
from vision.runtimes.base import RUNTIMES, RuntimeMissingError, RuntimeName, RuntimeUnusableError, installed
from vision.runtimes.exported import (
    FORMAT,
    INPUT,
    MAGIC,
    SUFFIXES,
    ExportedFacts,
    ExportKind,
    kind_of,
    split_facts,
    with_facts,
)
from vision.runtimes.network import Network
from vision.runtimes.source import read_source, runtime_of_file
from vision.runtimes.tensorrt_runtime import TensorRtRuntime, build_plan
from vision.runtimes.torch_runtime import TorchRuntime
from vision.weights import DEFAULT_WEIGHTS
from vision.yolo.checkpoint import load_checkpoint

PAIRS: list[tuple[ExportKind, RuntimeName]] = [
    ("onnx", "onnxruntime"),
    ("onnx", "openvino"),
    ("openvino", "openvino"),
    ("torchscript", "torch"),
]


@pytest.fixture(scope="module")
def exported(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Each kind is exported once."""
    folder = tmp_path_factory.mktemp("exported")
    made: dict[ExportKind, Path] = {}

    def of(kind: ExportKind) -> Path:
        needs(*{"onnx": ("onnx", "onnxruntime"), "openvino": ("openvino",)}.get(kind, ()))
        if kind not in made:
            (folder / kind).mkdir()
            copy = folder / kind / "net.pt"
            copy.write_bytes(checkpoint.read_bytes())
            made[kind] = export(copy, kind, image_size=96, model_family="YOLOv8")
        return made[kind]

    return of


@pytest.fixture(scope="module")
def reference(checkpoint: Path) -> TorchRuntime:
    return TorchRuntime(load_checkpoint(checkpoint).model, precision="float32")


@pytest.mark.parametrize(
    ("kind", "runtime"),
    [pytest.param(*each, marks=pytest.mark.slow if each == ("onnx", "openvino") else ()) for each in PAIRS],
)
def test_exported_network_matches_torch_at_every_size(
    exported: Any, reference: TorchRuntime, kind: ExportKind, runtime: RuntimeName
) -> None:
    needs(runtime)
    found = runtime_of_file(runtime, exported(kind), threads=1)
    # OpenVINO computes in bfloat16 where the processor does.
    for size in ((96, 96), (64, 160), (96, 96), (32, 32)):
        image = make_image(*size)
        for a, b in zip(found.infer(image), reference.infer(image), strict=True):
            assert a.sides is not None
            assert b.sides is not None
            np.testing.assert_allclose(a.sides, b.sides, atol=0.1)
            np.testing.assert_allclose(a.classes, b.classes, atol=0.1)
    assert found.name == runtime
    assert found.threads >= 1


ASKED: dict[str, Any] = {"image_size": 96, "precision": "float32", "classes": ["car", "boat"]}


@pytest.fixture(scope="module")
def source(checkpoint: Path) -> Detector:
    return Detector(checkpoint, **ASKED)


@pytest.mark.parametrize(("kind", "runtime"), PAIRS)
def test_an_exported_file_is_a_model_by_itself(
    exported: Any, checkpoint: Path, source: Detector, kind: ExportKind, runtime: RuntimeName
) -> None:
    """Without a name it runs on the runtime of its kind: for `.onnx` that is ONNX Runtime."""
    needs(runtime)
    path, named = exported(kind), (kind, runtime) == ("onnx", "openvino")
    alone = Detector(path, runtime=runtime if named else None, threads=1, **ASKED)
    assert alone.class_names == class_names_of(path) == class_names_of(checkpoint) == NAMES
    assert alone.metadata == {"licence": "Apache-2.0"}
    assert (alone.runtime, alone.precision) == (runtime, "float32")
    assert alone.runtime_reason == "as requested" if named else "default" in alone.runtime_reason
    assert source.runtime == "torch"
    assert "default" in source.runtime_reason
    image = make_image(64, 96)
    a, b = alone.detect(image), source.detect(image)
    assert len(a) == len(b)
    np.testing.assert_allclose(a.confidence, b.confidence, atol=1e-3)
    np.testing.assert_allclose(a.xyxy, b.xyxy, atol=0.1)


@pytest.mark.parametrize("others", [(), ("openvino",)])
def test_missing_default_runtime_is_named_and_not_replaced(
    exported: Any, monkeypatch: pytest.MonkeyPatch, others: tuple[str, ...]
) -> None:
    needs(*others)
    path = exported("onnx")
    real = importlib.util.find_spec
    absent = {"onnxruntime", "openvino"} - set(others)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in absent else real(name))
    for read in (Detector, class_names_of):
        with pytest.raises(RuntimeMissingError, match=r"pip install onnxruntime\b") as caught:
            read(path)
        assert ("runtime openvino" in str(caught.value)) is bool(others)


@pytest.mark.parametrize(("kind", "runtime"), [("onnx", "torch"), ("openvino", "onnxruntime")])
def test_a_named_runtime_of_other_files_is_refused(
    exported: Any, kind: ExportKind, runtime: RuntimeName
) -> None:
    path = exported(kind)
    for read in (Detector, class_names_of):
        with pytest.raises(RuntimeUnusableError, match=f"{runtime} cannot run {SUFFIXES[kind]} files"):
            read(path, runtime=runtime)


@pytest.mark.parametrize("kind", ["onnx", "openvino"])
def test_an_exported_file_is_run_without_torch(exported: Any, kind: ExportKind) -> None:
    runtime = {"onnx": "onnxruntime", "openvino": "openvino"}[kind]
    program = (
        "import sys, numpy as np; from vision.detector import Detector\n"
        f"found = Detector({str(exported(kind))!r}, image_size=96, threads=1)\n"
        "found.detect(np.zeros((64, 96, 3), np.uint8))\n"
        "print(found.runtime, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [runtime, "False"]


@pytest.mark.parametrize("kind", ["onnx", "openvino", "torchscript"])
def test_an_exported_file_carries_its_facts(exported: Any, checkpoint: Path, kind: ExportKind) -> None:
    facts = read_source(exported(kind)).facts
    assert facts is not None
    assert facts.class_names == NAMES
    assert facts.strides == (8, 16, 32)
    assert facts.model_family == "YOLOv8"
    assert facts.source_sha256 == hashlib.sha256(checkpoint.read_bytes()).hexdigest()


def test_export_is_written_beside_its_checkpoint(exported: Any) -> None:
    path = exported("torchscript")
    assert path == path.parent / "net.torchscript"
    assert sorted(path.name for path in path.parent.iterdir()) == ["net.pt", "net.torchscript"]


def test_file_with_wrong_outputs_is_not_kept(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_another(network: Any, facts: Any, path: Path) -> None:
        network.body.model[0].conv.weight.data.mul_(1.5)
        convert_network(network, facts, path)
        network.body.model[0].conv.weight.data.div_(1.5)

    convert_network = conversion._write_torchscript
    monkeypatch.setattr(conversion, "_write_torchscript", write_another)
    with pytest.raises(RuntimeUnusableError, match="differ from"):
        export(checkpoint, "torchscript", tmp_path / "net.torchscript", 64)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"to": "coreml"}, "tensorrt, torchscript"),
        ({"to": "torchscript", "image_size": 100}, "multiple of 32"),
        ({"to": "torchscript", "output": Path("net.onnx")}, r"\.torchscript"),
    ],
)
def test_invalid_export_is_rejected(checkpoint: Path, arguments: dict[str, Any], expected: str) -> None:
    with pytest.raises(RuntimeUnusableError, match=expected):
        export(checkpoint, **arguments)


@pytest.mark.parametrize("kind", ["onnx", "openvino", "torchscript"])
@pytest.mark.parametrize("damage", ["empty", "cut", "text", "missing"])
def test_a_damaged_file_is_one_line(exported: Any, tmp_path: Path, kind: ExportKind, damage: str) -> None:
    whole = exported(kind).read_bytes()
    path = tmp_path / f"net{SUFFIXES[kind]}"
    if damage != "missing":
        path.write_bytes({"empty": b"", "cut": whole[: len(whole) // 2], "text": b"hello\n" * 99}[damage])
    with pytest.raises(RuntimeUnusableError, match=path.name) as caught:
        read_source(path)
    assert "\n" not in str(caught.value)


def test_file_without_metadata_is_rejected(exported: Any, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(exported("onnx")))
    del model.metadata_props[:]
    onnx.save(model, str(tmp_path / "net.onnx"))
    with pytest.raises(RuntimeUnusableError, match="metadata"):
        read_source(tmp_path / "net.onnx")


@pytest.mark.parametrize("runtime", [name for name in RUNTIMES if name != "torch" and not installed(name)])
def test_export_for_a_missing_runtime_names_the_extra(
    checkpoint: Path, tmp_path: Path, runtime: RuntimeName
) -> None:
    kind = {"onnxruntime": "onnx", "openvino": "openvino", "tensorrt": "tensorrt"}[runtime]
    with pytest.raises(RuntimeMissingError, match=re.escape(install_command(runtime))):
        export(checkpoint, kind, tmp_path / f"net{SUFFIXES[kind]}")  # type: ignore[arg-type,index]


def test_onnx_export_does_not_need_onnxruntime(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs("onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    loaded = read_source(checkpoint)
    network = Network(loaded.take_model())
    facts = ExportedFacts(NAMES, network.head.strides, network.head.reg_max, False, 96, "0" * 64)
    path = tmp_path / "net.onnx"
    conversion.write_onnx(network, facts, path)
    assert path.stat().st_size > 0
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(RuntimeMissingError, match=r"mavlink-companion\[models\]"):
        conversion.write_onnx(network, facts, path)


PATH = Path("net.engine")
FACTS = ExportedFacts(
    ("person", "car"),
    (8, 16, 32),
    16,
    False,
    640,
    "ab" * 32,
    model_family="YOLOv8",
    metadata={"licence": "é"},
)

names = st.text(min_size=1, max_size=20)


@settings(max_examples=40)
@given(
    class_names=st.lists(names, min_size=1, max_size=5).map(tuple),
    strides=st.lists(st.integers(1, 128), min_size=1, max_size=4).map(tuple),
    reg_max=st.integers(1, 32),
    end_to_end=st.booleans(),
    fixed_size=st.none() | st.tuples(st.integers(32, 640), st.integers(32, 640)),
    metadata=st.dictionaries(names, st.integers() | names, max_size=3),
)
def test_facts_survive_the_round_trip(**values: object) -> None:
    facts = ExportedFacts(image_size=320, source_sha256="00", model_family="YOLO11", **values)  # type: ignore[arg-type]
    assert ExportedFacts.from_json(facts.to_json(), PATH) == facts


@given(text=st.text() | st.recursive(st.none() | st.integers() | st.text(), st.lists).map(json.dumps))
def test_anything_else_is_rejected_by_name(text: str) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"net\.engine"):
        ExportedFacts.from_json(text, PATH)


@pytest.mark.parametrize(
    "change",
    [
        {"format": "other"},
        {"class_names": []},
        {"class_names": [1]},
        {"strides": [0]},
        {"strides": ["8"]},
        {"reg_max": 1.5},
        {"fixed_size": [1]},
        {"metadata": []},
        {"end_to_end": 1},
        {"more": 1},
    ],
    ids=str,
)
def test_invalid_facts_are_rejected(change: dict[str, object]) -> None:
    text = json.dumps(json.loads(FACTS.to_json()) | change)
    with pytest.raises(RuntimeUnusableError, match=r"^net\.engine: .* \(.*export`"):
        ExportedFacts.from_json(text, PATH)


def test_facts_give_the_output_layout() -> None:
    head = FACTS.head()
    assert (head.strides, head.reg_max, head.end_to_end, head.class_ids) == ((8, 16, 32), 16, False, (0, 1))
    assert head.kinds == ("sides", "classes")


def test_a_plan_keeps_its_facts_before_it() -> None:
    facts, plan = split_facts(with_facts(FACTS, b"the plan"), PATH)
    assert facts == FACTS
    assert bytes(plan) == b"the plan"


@given(cut=st.integers(0, len(with_facts(FACTS, b"")) - 1))
def test_a_plan_that_is_cut_short_is_rejected(cut: int) -> None:
    with pytest.raises(RuntimeUnusableError):
        split_facts(with_facts(FACTS, b"")[:cut], PATH)


@given(content=st.binary() | st.binary().map(lambda tail: MAGIC + tail))
def test_foreign_plan_is_rejected(content: bytes) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"net\.engine"):
        split_facts(content, PATH)


def test_kind_follows_from_the_suffix() -> None:
    names = ("a/b.onnx", "b.xml", "b.engine", "b.torchscript", "b.pt")
    kinds = [kind_of(Path(name)) for name in names]
    assert kinds == ["onnx", "openvino", "tensorrt", "torchscript", None]
    assert FORMAT.endswith(".v1")


absent = pytest.mark.skipif(installed("tensorrt"), reason="TensorRT is installed here")


@pytest.fixture
def engine(tmp_path: Path) -> Path:
    path = tmp_path / "net.engine"
    path.write_bytes(with_facts(FACTS, b"a plan"))
    return path


@absent
def test_running_without_tensorrt_names_the_extra(engine: Path) -> None:
    with pytest.raises(RuntimeMissingError, match=r"mavlink-companion\[nvidia\]"):
        TensorRtRuntime(engine)
    with pytest.raises(RuntimeMissingError, match=r"mavlink-companion\[nvidia\]"):
        Detector(engine)  # the default of its kind of file


@absent
def test_building_without_tensorrt_names_the_extra(tmp_path: Path) -> None:
    with pytest.raises(RuntimeMissingError, match=r"mavlink-companion\[nvidia\]"):
        build_plan(tmp_path / "net.onnx", largest_side=640, stride=32)


def test_plan_metadata_is_readable_without_tensorrt(engine: Path) -> None:
    source = read_source(engine)
    assert source.class_names == ("person", "car")
    assert source.runners() == ("tensorrt",)


def test_a_precision_that_a_plan_does_not_have_is_rejected(engine: Path) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"float16.* bfloat16"):
        TensorRtRuntime(engine, precision="bfloat16")


class DataType(enum.Enum):
    UINT8 = "tensor(uint8)"
    HALF = "tensor(float16)"
    FLOAT = "tensor(float)"


class StandInEngine:
    """An ONNX file as a plan, computed by ONNX Runtime; it is its own execution context."""

    def __init__(self, plan: Any) -> None:
        import onnxruntime

        self.session = onnxruntime.InferenceSession(bytes(plan), providers=["CPUExecutionProvider"])
        self.ports = [*self.session.get_inputs(), *self.session.get_outputs()]
        self.num_io_tensors = len(self.ports)
        self.addresses: dict[str, int] = {}

    def get_tensor_name(self, index: int) -> str:
        return str(self.ports[index].name)

    def get_tensor_dtype(self, name: str) -> DataType:
        return next(DataType(port.type) for port in self.ports if port.name == name)

    def create_execution_context(self) -> StandInEngine:
        return self

    def set_input_shape(self, name: str, shape: tuple[int, ...]) -> bool:
        self.input = np.zeros(shape, np.uint8)
        self.results = dict(zip([port.name for port in self.ports[1:]], self.run(), strict=True))
        return True

    def run(self) -> Any:
        return self.session.run(None, {INPUT: self.input})

    def get_tensor_shape(self, name: str) -> tuple[int, ...]:
        return tuple(self.results[name].shape)

    def set_tensor_address(self, name: str, pointer: int) -> None:
        self.addresses[name] = pointer

    def execute_async_v3(self, stream: int) -> bool:
        ctypes.memmove(self.input.ctypes.data, self.addresses[INPUT], self.input.nbytes)
        for name, result in zip(self.results, self.run(), strict=True):
            ctypes.memmove(self.addresses[name], result.ctypes.data, result.nbytes)
        return True


class StandInTensorRt:
    """Those Python names of TensorRT that both 10 and 11 have, and CUDA's copies within the memory here."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.flags: list[int] = []
        self.parsed = b""
        self.buffers: list[Any] = []

        def copied(to: int, source: int, size: int, *_: Any) -> tuple[int]:
            ctypes.memmove(to, source, size)
            return (0,)

        def allocated(size: int) -> tuple[int, int]:
            self.buffers.append(ctypes.create_string_buffer(size))
            return 0, ctypes.addressof(self.buffers[-1])

        accepted = SimpleNamespace(
            create_network=self.flags.append,
            create_builder_config=lambda: SimpleNamespace(
                set_memory_pool_limit=lambda pool, size: None, add_optimization_profile=lambda profile: 0
            ),
            create_optimization_profile=lambda: SimpleNamespace(set_shape=lambda *shapes: None),
            build_serialized_network=lambda network, config: self.parsed,
        )
        of_tensorrt = {
            "Logger": type("Logger", (), {"ERROR": 1, "__init__": lambda *_: None}),
            "Builder": lambda log: accepted,
            "OnnxParser": lambda network, log: SimpleNamespace(parse_from_file=self.parse),
            "Runtime": lambda log: SimpleNamespace(deserialize_cuda_engine=StandInEngine),
            "NetworkDefinitionCreationFlag": enum.IntEnum("Flag", {"STRONGLY_TYPED": 1}),
            "MemoryPoolType": enum.Enum("MemoryPoolType", ["WORKSPACE"]),
            "DataType": DataType,
        }
        of_cuda = {
            "cudaStreamCreate": lambda: (0, 1),
            "cudaStreamSynchronize": lambda stream: (0,),
            "cudaMalloc": allocated,
            "cudaFree": lambda pointer: (0,),
            "cudaMemcpyAsync": copied,
            "cudaMemcpyKind": SimpleNamespace(cudaMemcpyHostToDevice=1, cudaMemcpyDeviceToHost=2),
        }
        for name, content in {"tensorrt": of_tensorrt, "cuda.bindings.runtime": of_cuda}.items():
            module = ModuleType(name)
            module.__spec__ = ModuleSpec(name, None)
            vars(module).update(content)
            monkeypatch.setitem(sys.modules, name, module)

    def parse(self, path: str) -> bool:
        self.parsed = Path(path).read_bytes()
        return True


@pytest.fixture
def tensorrt(monkeypatch: pytest.MonkeyPatch) -> StandInTensorRt:
    needs("onnx", "onnxruntime")
    return StandInTensorRt(monkeypatch)


def test_plan_is_built_strongly_typed_from_float16(
    tensorrt: StandInTensorRt, checkpoint: Path, reference: TorchRuntime, tmp_path: Path
) -> None:
    onnx = pytest.importorskip("onnx")
    path = export(checkpoint, "tensorrt", tmp_path / "net.engine", image_size=96)
    assert [found.name for found in tmp_path.iterdir()] == ["net.engine"]
    assert tensorrt.flags == [1 << 1]
    graph = onnx.load_from_string(tensorrt.parsed).graph
    weights = {
        node.output[0]: node.attribute[0].t.data_type for node in graph.node if node.op_type == "Constant"
    } | {tensor.name: tensor.data_type for tensor in graph.initializer}
    convolved = [weights[node.input[1]] for node in graph.node if node.op_type == "Conv"]
    # The last convolution of the classes of each level stays in float32.
    assert convolved.count(onnx.TensorProto.FLOAT) == 3
    assert convolved.count(onnx.TensorProto.FLOAT16) == len(convolved) - 3 == 30
    plan = TensorRtRuntime(path)
    assert plan.precision == "float16"
    for size in ((96, 96), (64, 96)):
        for a, b in zip(plan.infer(make_image(*size)), reference.infer(make_image(*size)), strict=True):
            np.testing.assert_allclose(a.classes, b.classes, atol=0.2)


def test_plan_has_the_boxes_of_float32(tensorrt: StandInTensorRt, tmp_path: Path) -> None:
    path = export(DEFAULT_WEIGHTS, "tensorrt", tmp_path / "net.engine", image_size=320)
    image = random_scene(np.random.default_rng(0), 640, 480)[0]
    expected = Detector("default", image_size=320, precision="float32").detect(image)
    found = Detector(path, image_size=320).detect(image)
    assert len(found) == len(expected) > 4
    np.testing.assert_allclose(found.xyxy, expected.xyxy, atol=0.5)
    np.testing.assert_allclose(found.confidence, expected.confidence, atol=0.01)


def test_plan_with_outputs_in_half_is_refused(
    tensorrt: StandInTensorRt, exported: Any, tmp_path: Path
) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(exported("onnx")))
    output = model.graph.output[0]
    cast = onnx.helper.make_node("Cast", [output.name], ["half"], to=onnx.TensorProto.FLOAT16)
    model.graph.node.append(cast)
    output.name, output.type.tensor_type.elem_type = "half", onnx.TensorProto.FLOAT16
    path = tmp_path / "net.engine"
    path.write_bytes(with_facts(FACTS, model.SerializeToString()))
    with pytest.raises(RuntimeUnusableError, match=r"half .*HALF.*FLOAT"):
        TensorRtRuntime(path)
