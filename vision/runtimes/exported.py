"""Metadata of an exported file, so that it can be loaded without its checkpoint.

The facts are stored in the file: ONNX metadata, OpenVINO's `rt_info`, TorchScript's extra files, and before a
TensorRT plan, which has no metadata, as `MAGIC`, their length (little-endian uint32) and the facts.
"""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from vision.runtimes.base import RuntimeUnusableError
from vision.yolo.level_outputs import Head

FORMAT = "mavlink-companion.network.v1"
KEY = "mavlink_companion"
MAGIC = b"MCNETWRK"
INPUT = "image_bgr"
_LONGEST_FACTS = 16 << 20

ExportKind = Literal["onnx", "openvino", "tensorrt", "torchscript"]
SUFFIXES: dict[ExportKind, str] = {
    "onnx": ".onnx",
    "openvino": ".xml",
    "tensorrt": ".engine",
    "torchscript": ".torchscript",
}


@dataclass(frozen=True, slots=True)
class ExportedFacts:
    """Metadata of one exported network.

    Attributes:
        class_names: id → name.
        strides, reg_max, end_to_end: layout of its outputs, see `Head`.
        image_size: pixels it was exported for; other sizes work too, unless `fixed_size` is set.
        fixed_size: (height, width) of the only accepted input; None: any multiples of the largest stride.
        model_family: of the network, from the export; may be empty.
        source_sha256: of the checkpoint.
        precision: of the file, `float32` or `int8`; a TensorRT plan computes in float16.
        metadata: of the checkpoint: licence, origin, score.
    """

    class_names: tuple[str, ...]
    strides: tuple[int, ...]
    reg_max: int
    end_to_end: bool
    image_size: int
    source_sha256: str
    precision: str = "float32"
    fixed_size: tuple[int, int] | None = None
    model_family: str = ""
    metadata: dict[str, Any] = field(default_factory=dict)

    def head(self) -> Head:
        classes = len(self.class_names)
        return Head(self.strides, self.reg_max, self.end_to_end, classes, tuple(range(classes)))

    def to_json(self) -> str:
        return json.dumps({"format": FORMAT, **asdict(self)}, ensure_ascii=True)

    @classmethod
    def from_json(cls, text: str, path: Path) -> ExportedFacts:
        """Parse the output of `to_json`. Raises `RuntimeUnusableError` for anything else."""
        try:
            plain = json.loads(text)
            if not isinstance(plain, dict) or plain.pop("format", None) != FORMAT:
                raise ValueError(f"the format is not {FORMAT}")
            facts = cls(**plain)
            names, strides = tuple(facts.class_names), tuple(facts.strides)
            fixed = None if facts.fixed_size is None else tuple(facts.fixed_size)
            integers = (*strides, facts.reg_max, facts.image_size, *(fixed or ()))
            if not names or not strides or not all(isinstance(name, str) for name in names):
                raise ValueError("no classes or no strides")
            if (
                not all(type(number) is int and number > 0 for number in integers)
                or len(fixed or (1, 1)) != 2
            ):
                raise ValueError("strides, bins and sizes must be integers above 0")
            if not isinstance(facts.metadata, dict) or not isinstance(facts.end_to_end, bool):
                raise ValueError("metadata is not a table")
        except (ValueError, TypeError, RecursionError) as error:
            raise RuntimeUnusableError(
                f"{path}: its metadata cannot be used ({error!s:.200}); "
                "export it again with `companion models export`"
            ) from None
        return replace(
            facts,
            class_names=names,
            strides=strides,
            fixed_size=None if fixed is None else (fixed[0], fixed[1]),
            source_sha256=str(facts.source_sha256),
            precision=str(facts.precision),
            model_family=str(facts.model_family),
        )


def own_facts(facts: object, path: Path) -> ExportedFacts:
    """`facts`, if they are of our own export. Raises `RuntimeUnusableError`."""
    if not isinstance(facts, ExportedFacts):
        raise not_ours(path)
    return facts


def not_ours(path: Path) -> RuntimeUnusableError:
    """The error for a file without facts."""
    return RuntimeUnusableError(
        f"{path}: has no {KEY} metadata; export it from the checkpoint with `companion models export`"
    )


def kind_of(path: Path) -> ExportKind | None:
    """The kind by the file suffix; None for a checkpoint. A folder is OpenVINO's."""
    if path.is_dir():
        return "openvino"
    return next((kind for kind, suffix in SUFFIXES.items() if path.suffix == suffix), None)


def with_facts(facts: ExportedFacts, plan: bytes) -> bytes:
    """A TensorRT plan preceded by its facts."""
    text = facts.to_json().encode()
    return MAGIC + struct.pack("<I", len(text)) + text + plan


def split_facts(content: bytes, path: Path) -> tuple[ExportedFacts, memoryview]:
    """The inverse of `with_facts`; the plan is not copied."""
    view = memoryview(content)
    start = len(MAGIC) + 4
    if len(content) < start or view[: len(MAGIC)] != MAGIC:
        raise not_ours(path)
    (length,) = struct.unpack("<I", view[len(MAGIC) : start])
    if length > min(_LONGEST_FACTS, len(content) - start):
        raise RuntimeUnusableError(f"{path}: is truncated; export it again with `companion models export`")
    text = bytes(view[start : start + length]).decode(errors="replace")
    return ExportedFacts.from_json(text, path), view[start + length :]
