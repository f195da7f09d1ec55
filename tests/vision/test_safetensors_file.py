"""Safetensors files: round trip, and damaged files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from vision.yolo.safe_pickle import CheckpointError
from vision.yolo.safetensors_file import read_safetensors, write_safetensors


def raw(header: Any, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def entry(dtype: Any = "F32", shape: Any = (2,), offsets: Any = (0, 8)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


def test_round_trip(tmp_path: Path) -> None:
    dtypes = (torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool)
    tensors = {f"a.{dtype}": (torch.randn(2, 3) * 9).to(dtype) for dtype in dtypes}
    tensors |= {"scalar": torch.tensor(3.5), "none": torch.zeros(0, 4), "turned": torch.randn(4, 5).T}
    path = tmp_path / "a.safetensors"
    write_safetensors(path, tensors, {"licence": "Apache-2.0"})
    content = read_safetensors(path)
    assert content.metadata == {"licence": "Apache-2.0"}
    assert content.tensors.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert content.tensors[name].dtype == tensor.dtype
        assert torch.equal(content.tensors[name], tensor)


def test_tensors_do_not_change_when_the_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_safetensors(path, {"a": torch.ones(1000)}, {})
    tensor = read_safetensors(path).tensors["a"]
    write_safetensors(path, {"a": torch.zeros(1000)}, {})
    assert torch.equal(tensor, torch.ones(1000))


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"\xff" * 8, id="a header longer than the file"),
        pytest.param((1 << 40).to_bytes(8, "little") + b"{}", id="a huge header"),
        pytest.param(raw(b" " * (5 << 20)), id="a header of 5 MB"),
        pytest.param(raw(b"[]"), id="a list"),
        pytest.param(raw(b"{"), id="half a header"),
        pytest.param(raw(b'{"\xff": 1}'), id="not UTF-8"),
        pytest.param(raw(b'{"a": ' + b"[" * 50_000), id="deep"),
        pytest.param(raw({"a": 1}), id="not a tensor"),
        pytest.param(raw({"a": entry(dtype="F99")}, bytes(8)), id="an unknown type"),
        pytest.param(raw({"a": entry(shape=[-2])}, bytes(8)), id="a negative shape"),
        pytest.param(raw({"a": entry(shape=[3])}, bytes(8)), id="another size"),
        pytest.param(raw({"a": entry(shape=[1 << 39, 1 << 39], offsets=[0, 1 << 80])}), id="huge"),
        pytest.param(raw({"a": entry(), "b": entry()}, bytes(8)), id="overlap"),
        pytest.param(raw({"a": entry(offsets=[8, 16])}, bytes(16)), id="a gap"),
        pytest.param(raw({"a": entry()}, bytes(12)), id="left over"),
        pytest.param(raw({"a": entry()}, bytes(4)), id="truncated"),
        pytest.param(raw({"__metadata__": {"a": 1}}), id="metadata that are not texts"),
    ],
)
def test_a_damaged_file_is_a_checkpoint_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)
    with pytest.raises(CheckpointError):
        read_safetensors(path)


def test_a_missing_file_and_a_folder_are_checkpoint_errors(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.safetensors", tmp_path):
        with pytest.raises(CheckpointError, match="safetensors"):
            read_safetensors(path)


def test_complex_numbers_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="complex64"):
        write_safetensors(tmp_path / "a.safetensors", {"a": torch.zeros(2, dtype=torch.complex64)}, {})
