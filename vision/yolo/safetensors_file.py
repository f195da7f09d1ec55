"""The safetensors format, read and written: eight bytes of length, a JSON header, raw numbers. Nothing else.

Our own reader rather than the library's: the format is three lines long, this costs a board no further wheel,
and its header is bounded far below the library's 100 MB, so that a hostile file cannot make it large.
Format: https://github.com/huggingface/safetensors, "Format".
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from vision.yolo.safe_pickle import CheckpointError

DTYPES: dict[str, torch.dtype] = {
    "F64": torch.float64,
    "F32": torch.float32,
    "F16": torch.float16,
    "BF16": torch.bfloat16,
    "I64": torch.int64,
    "I32": torch.int32,
    "I16": torch.int16,
    "I8": torch.int8,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}
_NAMES = {dtype: name for name, dtype in DTYPES.items()}
_LARGEST_HEADER_BYTES = 4 << 20
_MOST_TENSORS = 20_000
_MOST_VALUES_PER_TENSOR = 16
_MOST_DIMENSIONS = 8
_METADATA_KEY = "__metadata__"


@dataclass(frozen=True, slots=True)
class SafetensorsContent:
    """What a file holds: tensors on the CPU by name, and its free texts."""

    tensors: dict[str, Tensor]
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True)
class _Entry:
    name: str
    dtype: torch.dtype
    shape: tuple[int, ...]
    begin: int
    end: int


def read_safetensors(path: Path) -> SafetensorsContent:
    """Read every tensor of `path`; takes as much memory as the file.

    Raises:
        CheckpointError: missing, truncated, or a header that is not of the format: tensors that overlap,
            leave gaps, or are not as long as their shape and type say.
    """
    try:
        with path.open("rb") as file:
            return _read(file, os.fstat(file.fileno()).st_size)
    except FileNotFoundError:
        raise CheckpointError("no such file; the weights of a pair are NAME.safetensors") from None
    except IsADirectoryError:
        raise CheckpointError("is a folder; give the path of a .safetensors file") from None
    except OSError as error:
        raise CheckpointError(f"cannot be read ({error.strerror or error})") from None


def _read(file: BinaryIO, size: int) -> SafetensorsContent:
    if size < 8:
        raise CheckpointError(
            f"the file has {size} bytes, a safetensors file at least 8; copy or download it again"
        )
    length = int.from_bytes(file.read(8), "little")
    if length > min(size - 8, _LARGEST_HEADER_BYTES):
        raise CheckpointError(
            f"its header should have {length} bytes, of {size} in the file, and at most "
            f"{_LARGEST_HEADER_BYTES} make sense; it is truncated, or no safetensors file"
        )
    header = _parse(file.read(length))
    texts = header.pop(_METADATA_KEY, {})
    if not isinstance(texts, dict) or not all(isinstance(text, str) for text in texts.values()):
        raise CheckpointError("its metadata must be texts")
    entries = sorted((_entry(name, value) for name, value in header.items()), key=lambda e: (e.begin, e.end))
    position = 0
    for entry in entries:
        if entry.begin != position:
            raise CheckpointError(
                f"the tensor {entry.name!r:.100} begins at byte {entry.begin}, expected {position}: "
                "tensors must neither overlap nor leave gaps"
            )
        position = entry.end
    if position != size - 8 - length:
        raise CheckpointError(
            f"its tensors have {position} bytes, the file has {size - 8 - length}; copy or download it again"
        )
    return SafetensorsContent({entry.name: _tensor(file, entry) for entry in entries}, texts)


def _parse(data: bytes) -> dict[str, Any]:
    if not data.startswith(b"{"):
        raise CheckpointError("its header is not a JSON object; it is no safetensors file")
    # A value becomes an object of Python's, twenty times as large as a bracket: counted before it is made.
    if sum(data.count(sign) for sign in b"[{,") > _MOST_TENSORS * _MOST_VALUES_PER_TENSOR:
        raise CheckpointError("its header has more values than a checkpoint's")
    try:
        header = json.loads(data.decode("utf-8"), object_pairs_hook=_without_duplicates)
    except CheckpointError:
        raise
    except (ValueError, RecursionError) as error:  # JSONDecodeError and UnicodeDecodeError are ValueErrors
        raise CheckpointError(f"its header is not JSON ({error})") from None
    assert isinstance(header, dict)  # It begins with a brace.
    return header


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) != len(pairs):
        raise CheckpointError("its header names something twice")
    return made


def _entry(name: str, value: Any) -> _Entry:
    if not isinstance(value, dict) or value.keys() != {"dtype", "shape", "data_offsets"}:
        raise CheckpointError(f"the tensor {name!r:.100} must have dtype, shape and data_offsets, no more")
    kind, shape, offsets = value["dtype"], value["shape"], value["data_offsets"]
    dtype = DTYPES.get(kind) if isinstance(kind, str) else None
    if dtype is None:
        raise CheckpointError(
            f"the tensor {name!r:.100} has the type {kind!s:.100}, known are {', '.join(DTYPES)}"
        )
    if not _are_counts(shape) or len(shape) > _MOST_DIMENSIONS:
        raise CheckpointError(f"the tensor {name!r:.100} has an impossible shape")
    if not _are_counts(offsets) or len(offsets) != 2:
        raise CheckpointError(f"the tensor {name!r:.100} must have two data_offsets, begin and end")
    begin, end = offsets
    expected = math.prod(shape) * dtype.itemsize
    if end - begin != expected:
        raise CheckpointError(
            f"the tensor {name!r:.100} of shape {tuple(shape)} and type {kind} needs {expected} bytes, "
            f"its offsets are {begin} to {end}"
        )
    return _Entry(name, dtype, tuple(shape), begin, end)


def _are_counts(values: object) -> bool:
    return isinstance(values, list) and all(type(value) is int and 0 <= value < 1 << 40 for value in values)


def _tensor(file: BinaryIO, entry: _Entry) -> Tensor:
    """The next tensor of the file, read straight into its own memory."""
    if entry.begin == entry.end:
        return torch.empty(entry.shape, dtype=entry.dtype)
    data = bytearray(entry.end - entry.begin)
    if file.readinto(data) != len(data):  # type: ignore[attr-defined]
        raise CheckpointError(f"ends in the middle of the tensor {entry.name!r:.100}; copy it again")
    if entry.dtype is torch.bool and max(data) > 1:
        raise CheckpointError(f"the tensor {entry.name!r:.100} has truth values other than 0 and 1")
    return torch.frombuffer(data, dtype=entry.dtype).reshape(entry.shape)


def write_safetensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write `tensors` (of the types in `DTYPES`) at `path`, in the order of their names, and reach the disk.

    Raises:
        TypeError: a tensor of another type, or metadata that are not texts.
    """
    header: dict[str, Any] = {}
    if metadata:
        if not all(isinstance(text, str) for item in metadata.items() for text in item):
            raise TypeError("the metadata of a safetensors file must be texts")
        header[_METADATA_KEY] = dict(metadata)
    position = 0
    ordered = sorted(tensors.items())
    for name, tensor in ordered:
        if tensor.dtype not in _NAMES:
            raise TypeError(f"{name} is {tensor.dtype}, safetensors files hold {', '.join(_NAMES.values())}")
        size = tensor.numel() * tensor.dtype.itemsize
        offsets = [position, position + size]
        header[name] = {"dtype": _NAMES[tensor.dtype], "shape": list(tensor.shape), "data_offsets": offsets}
        position += size
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # The numbers begin aligned, as the format recommends.
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for _, tensor in ordered:
            raw = tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8)
            file.write(raw.numpy().data)
        file.flush()
        os.fsync(file.fileno())
