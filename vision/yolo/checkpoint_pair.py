"""A checkpoint as two plain files: `NAME.safetensors`, the weights, and `NAME.yaml`, their description.

The YAML file contains `format`, `weights` (file name, size, SHA-256 of the other), `architecture` (class
names, the rows of the network) and further metadata: licence, training, score. Neither file can contain code.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from safetensors import SafetensorError, safe_open

from vision.file_kinds import explained, open_file
from vision.plain_yaml import PlainDumper, PlainYamlError, load_plain_yaml, numbered
from vision.text_file import read_text
from vision.yolo.checkpoint_error import CheckpointError, one_line

if TYPE_CHECKING:
    from torch import Tensor

PAIR_FORMAT = "mavlink-companion.yolo.v2"
WEIGHTS_SUFFIX = ".safetensors"
DESCRIPTION_SUFFIXES = (".yaml", ".yml")
_LARGEST_DESCRIPTION_BYTES = 2 << 20
# The library accepts headers of 100 MB, which take gigabytes to parse; a network's has a few hundred kB.
_MAX_HEADER_BYTES = 4 << 20


def is_pair(path: Path) -> bool:
    """Whether `path` names one of the two files of a pair."""
    return path.suffix.lower() in (WEIGHTS_SUFFIX, *DESCRIPTION_SUFFIXES)


def pair_paths(path: Path) -> tuple[Path, Path]:
    """Either file of a pair → (weights, description). Of `.yaml` and `.yml` the existing one."""
    if path.suffix.lower() in DESCRIPTION_SUFFIXES:
        return path.with_suffix(WEIGHTS_SUFFIX), path
    candidates = [path.with_suffix(suffix) for suffix in DESCRIPTION_SUFFIXES]
    return path, next((candidate for candidate in candidates if candidate.is_file()), candidates[0])


def read_pair(path: Path) -> dict[str, Any]:
    """Read both files → `description`, `state_dict`, `metadata`.

    Raises:
        CheckpointError: a file is missing or damaged, or the two do not match. One line.
    """
    weights_path, description_path = pair_paths(path)
    table = _read_description(description_path, weights_path)
    declared = table.pop("weights", {})
    try:
        _check_belongs(weights_path, declared, description_path)
        tensors, metadata = read_safetensors(weights_path)
    except CheckpointError as error:
        raise CheckpointError(one_line(f"{weights_path}: {error}")) from None
    architecture = table.pop("architecture", None)
    if not isinstance(architecture, dict):
        raise CheckpointError(
            f"{description_path}: has no `architecture`: expected a table with names, backbone and head"
        )
    names = architecture.get("names", table.pop("names", None))
    if isinstance(names, dict):
        names = numbered(names)
        if names is None:
            raise CheckpointError(f"{description_path}: its class names are not numbered from 0")
    return {
        "description": {**architecture, "names": names},
        "state_dict": tensors,
        "metadata": {**metadata, **table},
    }


def write_pair(
    path: Path, description: Mapping[str, Any], tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]
) -> None:
    """Write `path` (`NAME.safetensors`) and `NAME.yaml`; a reader never sees a partly written file.

    Args:
        description: of the network, `ModelDescription.to_plain()`.
        metadata: plain values; the keys `format`, `weights` and `architecture` are reserved.
    """
    reserved = metadata.keys() & {"format", "weights", "architecture"}
    if reserved:
        raise ValueError(f"the metadata must not have the key {sorted(reserved)[0]!r}")
    description_path = path.with_suffix(DESCRIPTION_SUFFIXES[0])
    weights_partial = path.with_name(f"{path.name}.partial")
    description_partial = description_path.with_name(f"{description_path.name}.partial")
    write_safetensors(weights_partial, tensors, {})
    table = {
        "format": PAIR_FORMAT,
        "weights": {
            "file": path.name,
            "bytes": weights_partial.stat().st_size,
            "sha256": file_sha256(weights_partial),
        },
        **metadata,
        "architecture": _one_line_rows(description),
    }
    with description_partial.open("w", encoding="utf-8") as file:
        file.write("# What is in the file of the same name that ends in .safetensors.\n")
        # The emitter treats this one character as a line break if it is not escaped.
        readable = "\\x85" not in repr(table)
        yaml.dump(table, file, Dumper=_Dumper, sort_keys=False, allow_unicode=readable, width=110)
        file.flush()
        os.fsync(file.fileno())
    # After a power failure between the two, the checksum shows that they do not match.
    os.replace(weights_partial, path)
    os.replace(description_partial, description_path)


def file_sha256(path: Path) -> str:
    """The file's SHA-256, 64 hexadecimal digits."""
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def weights_sha256(path: Path) -> str:
    """Identifies a model: the SHA-256 of the checkpoint, or of a pair's weights."""
    return file_sha256(pair_paths(path)[0] if is_pair(path) else path)


def _read_description(path: Path, weights_path: Path) -> dict[str, Any]:
    try:
        size = path.stat().st_size
        if size > _LARGEST_DESCRIPTION_BYTES:
            raise CheckpointError(f"{path}: has {size} bytes, the limit is {_LARGEST_DESCRIPTION_BYTES}")
        table = load_plain_yaml(read_text(path))
    except FileNotFoundError:
        raise CheckpointError(
            f"{path}: no such file; {weights_path.name} needs it beside it, as the description of the weights"
        ) from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        raise CheckpointError(explained(path, f"{path}: {error}")) from None
    except PlainYamlError as error:
        raise CheckpointError(one_line(explained(path, f"{path}: {error}"))) from None
    if not isinstance(table, dict):
        raise CheckpointError(f"{path}: expected a table with `format` and `architecture`")
    found = table.pop("format", None)
    if found != PAIR_FORMAT:
        raise CheckpointError(
            one_line(f"{path}: has format {found!s:.100}, this version reads {PAIR_FORMAT!r}")
        )
    return table


def _check_belongs(weights_path: Path, declared: Any, description_path: Path) -> None:
    """Compare the weights with their checksum in the description, if it has one."""
    if not isinstance(declared, dict):
        raise CheckpointError(f"`weights` in {description_path.name} must be a table, or left out")
    expected = declared.get("sha256")
    if expected is None:
        return
    try:
        found = file_sha256(weights_path)
    except FileNotFoundError:
        return  # The reader reports it.
    except OSError as error:
        raise CheckpointError(f"cannot be read ({error.strerror or error})") from None
    if found != expected:
        raise CheckpointError(
            f"has the SHA-256 {found}, {description_path.name} was written for {expected!s:.100}; "
            "the two do not match, copy both again"
        )


class _Row(list[Any]):
    """A list to be written on one line."""


class _Dumper(PlainDumper):
    pass


_Dumper.add_representer(
    _Row, lambda dumper, row: dumper.represent_sequence("tag:yaml.org,2002:seq", row, flow_style=True)
)


def _one_line_rows(description: Mapping[str, Any]) -> dict[str, Any]:
    """The description with one line per row of the network."""
    return {
        key: [_Row(row) if isinstance(row, list) else row for row in value]
        if key in ("backbone", "head")
        else (_Row(value) if isinstance(value, list) else value)
        for key, value in description.items()
    }


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Every tensor of `path`, on the CPU, by name, and the header's texts; needs as much memory as the file.

    Raises:
        CheckpointError: the file is missing, truncated, or invalid.
    """
    try:
        with open_file(path) as file:
            size, length = os.fstat(file.fileno()).st_size, int.from_bytes(file.read(8), "little")
        if size >= 8 and length > _MAX_HEADER_BYTES:
            raise CheckpointError(
                f"its header has {length} bytes, expected at most {_MAX_HEADER_BYTES}; "
                "it is damaged, or not a safetensors file"
            )
        with safe_open(path, framework="pt", device="cpu") as content:
            # Cloned: the library's tensors are views of the mapped file, which may be replaced.
            tensors = {name: content.get_tensor(name).clone() for name in content.keys()}  # noqa: SIM118
            return tensors, content.metadata() or {}
    except FileNotFoundError:
        raise CheckpointError("no such file; the weights of a pair are NAME.safetensors") from None
    except IsADirectoryError:
        raise CheckpointError("is a folder; give the path of a .safetensors file") from None
    except OSError as error:
        raise CheckpointError(f"cannot be read ({error.strerror or error})") from None
    except CheckpointError:
        raise
    except (SafetensorError, UnicodeDecodeError, ValueError, OverflowError) as error:
        raise CheckpointError(
            f"not a safetensors file, or damaged ({error}); copy or download it again"
        ) from None


def write_safetensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write `tensors` and `metadata` to `path`, and sync to disk.

    Raises:
        TypeError: a tensor of a type that the format does not support.
    """
    from safetensors.torch import save  # imports torch

    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    for name, tensor in contiguous.items():
        if tensor.dtype.is_complex or tensor.is_quantized:
            raise TypeError(f"{name} is {tensor.dtype}; safetensors files hold real numbers")
    data = save(contiguous, dict(metadata) or None)
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
