"""The safetensors format: what was written is read, also by the format's own library; all else is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vision.yolo.safe_pickle import CheckpointError
from vision.yolo.safetensors_file import DTYPES, read_safetensors, write_safetensors

SHAPES = st.lists(st.integers(0, 5), max_size=4)
TENSORS = st.dictionaries(
    st.text(min_size=1, max_size=12).filter(lambda name: name != "__metadata__"),
    st.tuples(st.sampled_from(sorted(DTYPES)), SHAPES),
    max_size=6,
)


def made(kinds: dict[str, tuple[str, list[int]]]) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return {name: (torch.randn(shape) * 9).to(DTYPES[kind]) for name, (kind, shape) in kinds.items()}


def raw(header: Any, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(TENSORS, st.dictionaries(st.text(max_size=5), st.text(max_size=5), max_size=2))
def test_what_was_written_is_read_back(
    tmp_path: Path, kinds: dict[str, tuple[str, list[int]]], metadata: dict[str, str]
) -> None:
    tensors = made(kinds)
    write_safetensors(tmp_path / "a.safetensors", tensors, metadata)
    content = read_safetensors(tmp_path / "a.safetensors")
    assert content.metadata == metadata
    assert content.tensors.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert content.tensors[name].dtype == tensor.dtype
        assert torch.equal(content.tensors[name], tensor)


def test_the_formats_own_library_reads_ours_and_we_read_its(tmp_path: Path) -> None:
    library = pytest.importorskip("safetensors.torch", reason="the safetensors library is not installed")
    tensors = made({"a": ("F32", [2, 3]), "b": ("BF16", [4]), "c": ("I64", []), "d": ("F16", [1, 5])})
    ours, theirs = tmp_path / "ours.safetensors", tmp_path / "theirs.safetensors"
    write_safetensors(ours, tensors, {"licence": "Apache-2.0"})
    library.save_file(tensors, theirs, {"licence": "Apache-2.0"})
    read_by_them, read_by_us = library.load_file(ours), read_safetensors(theirs)
    assert read_by_us.metadata == {"licence": "Apache-2.0"}
    for name, tensor in tensors.items():
        assert torch.equal(read_by_them[name], tensor)
        assert torch.equal(read_by_us.tensors[name], tensor)


def entry(dtype: Any = "F32", shape: Any = (2,), offsets: Any = (0, 8)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        pytest.param(b"", "at least 8", id="empty"),
        pytest.param(b"\xff" * 8, "its header should have", id="a header longer than the file"),
        pytest.param((1 << 40).to_bytes(8, "little") + b"{}", "its header should have", id="a huge header"),
        pytest.param(raw(b"[]"), "not a JSON object", id="a list"),
        pytest.param(raw(b"{"), "not JSON", id="half a header"),
        pytest.param(raw(b'{"\xff": 1}'), "not JSON", id="not UTF-8"),
        pytest.param(raw(b'{"a": ' + b"[" * 50_000), "not JSON", id="deep"),
        pytest.param(raw(b'{"a": 1, "a": 1}'), "twice", id="a name twice"),
        pytest.param(raw({"a": 1}), "must have dtype", id="not a tensor"),
        pytest.param(raw({"a": entry() | {"more": 1}}, bytes(8)), "no more", id="an unknown key"),
        pytest.param(raw({"a": entry(dtype="F8_E4M3")}, bytes(8)), "type F8_E4M3, known are", id="a type"),
        pytest.param(raw({"a": entry(dtype=["F32"])}, bytes(8)), "known are", id="a list as type"),
        pytest.param(raw({"a": entry(shape=[-2])}, bytes(8)), "impossible shape", id="negative"),
        pytest.param(raw({"a": entry(shape=[2.0])}, bytes(8)), "impossible shape", id="half a row"),
        pytest.param(raw({"a": entry(shape=[True, 2])}, bytes(8)), "impossible shape", id="true rows"),
        pytest.param(raw({"a": entry(shape=[3])}, bytes(8)), "needs 12 bytes", id="another size"),
        pytest.param(
            raw({"a": entry(shape=[1 << 39, 1 << 39], offsets=[0, 1 << 80])}), "data_offsets", id="huge"
        ),
        pytest.param(raw({"a": entry(), "b": entry()}, bytes(8)), "neither overlap", id="overlap"),
        pytest.param(raw({"a": entry(offsets=[8, 16])}, bytes(16)), "nor leave gaps", id="a gap"),
        pytest.param(raw({"a": entry()}, bytes(12)), "have 8 bytes, the file has 12", id="left over"),
        pytest.param(raw({"a": entry()}, bytes(4)), "have 8 bytes, the file has 4", id="truncated"),
        pytest.param(raw({"a": entry("BOOL", [2], [0, 2])}, b"\x01\x02"), "truth values", id="truth"),
        pytest.param(raw({"__metadata__": {"a": 1}}), "must be texts", id="metadata"),
    ],
)
def test_anything_else_is_refused_by_name(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=says):
        read_safetensors(path)


def test_a_tensor_of_a_type_that_the_format_lacks_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="complex64"):
        write_safetensors(tmp_path / "a.safetensors", {"a": torch.zeros(2, dtype=torch.complex64)}, {})
