"""`companion models show`: the available models, and the description of a model file."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vision.catalog import KNOWN, known_by_digest
from vision.detector import Detector
from vision.model_files import kept_models
from vision.runtimes.selection import RuntimeChoice
from vision.weights import DEFAULT_EXPORT
from vision.yolo.checkpoint_pair import is_pair, pair_paths, weights_sha256


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """Description of a model file.

    Attributes:
        file, size_bytes, sha256: of the file that holds the weights.
        model_family, scale: for example YOLOv8 and n; an unpublished size has the scale "own", YOLOv3-tiny
            an empty one.
        parameters: number of trainable parameters.
        gflops: multiplications and additions counted separately, for one square image of `image_size` pixels.
        end_to_end: the head needs no NMS.
        classes: id → name.
        licence: as stated in the file; None if missing.
        official: name of this file in the catalogue; None for other files.
        runtime, runtime_reason: the runtime on this computer, and the reason.
        precision, precision_reason: its precision on this computer, and the reason.
        stated: further metadata in the file.
    """

    file: str
    size_bytes: int
    sha256: str
    model_family: str
    scale: str
    parameters: int
    gflops: float
    image_size: int
    end_to_end: bool
    classes: tuple[str, ...]
    licence: str | None
    official: str | None
    runtime: str
    runtime_reason: str
    precision: str
    precision_reason: str
    stated: dict[str, Any]

    def plain(self) -> dict[str, Any]:
        return asdict(self)


def model_info(path: Path, image_size: int = 640, runtime: RuntimeChoice | None = None) -> ModelInfo:
    """Read and describe a checkpoint, and load it to determine its precision on this computer.

    Raises:
        CheckpointError: it cannot be read. ValueError: the image size is not a multiple of 32.
        RuntimeUnusableError: the runtime is missing or does not support the model.
    """
    if image_size < 32 or image_size % 32:
        raise ValueError(f"the image size must be a multiple of 32, got {image_size}")
    # They import torch.
    from vision.training.published import describe
    from vision.yolo.checkpoint import load_checkpoint

    loaded = load_checkpoint(path)
    weights = pair_paths(path)[0] if is_pair(path) else path
    digest = weights_sha256(path)
    facts = describe(loaded.model, image_size)
    official = known_by_digest(digest)
    detector = Detector(path, image_size=image_size, runtime=runtime)
    stated = dict(loaded.metadata)
    licence = stated.pop("licence", None)
    return ModelInfo(
        file=str(weights),
        size_bytes=weights.stat().st_size,
        sha256=digest,
        model_family=facts.model_family,
        scale="own" if facts.scale is None else facts.scale,
        parameters=facts.parameters,
        gflops=round(facts.gflops, 2),
        image_size=image_size,
        end_to_end=facts.end_to_end,
        classes=loaded.class_names,
        licence=None if licence is None else str(licence),
        official=None if official is None else official.name,
        runtime=detector.runtime,
        runtime_reason=detector.runtime_reason,
        precision=detector.precision,
        precision_reason=detector.precision_reason,
        stated=stated,
    )


def info_lines(info: ModelInfo) -> list[str]:
    """Return the description as text lines."""
    shown_classes = ", ".join(info.classes[:12]) + (", …" if len(info.classes) > 12 else "")
    rows = {
        "file": f"{info.file} ({info.size_bytes} bytes)",
        "sha256": info.sha256,
        "official": f"{info.official} ({KNOWN[info.official].url})"
        if info.official
        else "not in the catalogue",
        "family": f"{info.model_family}, scale {info.scale}" if info.scale else info.model_family,
        "head": "end to end, without NMS" if info.end_to_end else "with NMS",
        "parameters": f"{info.parameters / 1e6:.2f} million",
        "work": f"{info.gflops:.1f} GFLOPs for {info.image_size}x{info.image_size}",
        "classes": f"{len(info.classes)}: {shown_classes}",
        "runs here": f"on {info.runtime} ({info.runtime_reason})",
        "precision": f"{info.precision} ({info.precision_reason})",
        "licence": info.licence or "not stated in the file",
        **{
            key: str(value)
            for key, value in info.stated.items()
            if isinstance(value, str | int | float) and key not in ("file",)
        },
    }
    width = max(map(len, rows))
    return [f"{name:<{width}}  {value}" for name, value in rows.items()]


def list_rows(*folders: Path) -> list[dict[str, Any]]:
    """Return every model: bundled, in `folders`, and official; with a `state` each."""
    kept = {path.name: path for path in kept_models(*folders)}
    rows: list[dict[str, Any]] = [
        {
            "name": "default",
            "state": "bundled",
            "size_bytes": DEFAULT_EXPORT.stat().st_size if DEFAULT_EXPORT.is_file() else None,
            "licence": "Apache-2.0",
            "about": "the model of this package, for rendered scenes",
            "path": str(DEFAULT_EXPORT),
        }
    ]
    for model in KNOWN.values():
        path = kept.pop(model.file, None)
        rows.append(
            {
                "name": model.name,
                "state": "can be pulled" if path is None else "here",
                "size_bytes": model.size_bytes if path is None else path.stat().st_size,
                "licence": model.licence,
                "about": model.about,
                "path": None if path is None else str(path),
            }
        )
    rows.extend(
        {
            "name": path.name,
            "state": "here",
            "size_bytes": path.stat().st_size,
            "licence": None,
            "about": f"in {path.parent}",
            "path": str(path),
        }
        for path in kept.values()
    )
    return rows
