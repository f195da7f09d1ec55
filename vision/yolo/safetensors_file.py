"""Reads and writes safetensors files with their library; every error is a `CheckpointError`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from vision.yolo.safe_pickle import CheckpointError

# The library accepts headers of 100 MB, which take gigabytes to parse; a network's has a few hundred kB.
_MAX_HEADER_BYTES = 4 << 20


@dataclass(frozen=True, slots=True)
class SafetensorsContent:
    """Tensors on the CPU by name, and the string metadata of the header."""

    tensors: dict[str, Tensor]
    metadata: dict[str, str]


def read_safetensors(path: Path) -> SafetensorsContent:
    """Read every tensor of `path`; needs as much memory as the file.

    Raises:
        CheckpointError: the file is missing, truncated, or invalid.
    """
    try:
        with path.open("rb") as file:
            size, length = os.fstat(file.fileno()).st_size, int.from_bytes(file.read(8), "little")
        if size >= 8 and length > _MAX_HEADER_BYTES:
            raise CheckpointError(
                f"its header has {length} bytes, expected at most {_MAX_HEADER_BYTES}; "
                "it is damaged, or not a safetensors file"
            )
        with safe_open(path, framework="pt", device="cpu") as content:
            # Cloned: the library's tensors are views of the mapped file, which may be replaced.
            tensors = {name: content.get_tensor(name).clone() for name in content.keys()}  # noqa: SIM118
            return SafetensorsContent(tensors, content.metadata() or {})
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
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    for name, tensor in contiguous.items():
        if tensor.dtype.is_complex or tensor.is_quantized:
            raise TypeError(f"{name} is {tensor.dtype}; safetensors files hold real numbers")
    data = save(contiguous, dict(metadata) or None)
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
