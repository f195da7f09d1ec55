"""`companion models show` of an exported file, ours or another exporter's, and of a YOLOX checkpoint."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from vision.detector import Detector
from vision.foreign.layouts import LAYOUTS, TASKS
from vision.runtimes.selection import RuntimeChoice
from vision.runtimes.source import ModelSource
from vision.yolo.checkpoint_pair import weights_sha256


@dataclass(frozen=True, slots=True)
class ExportInfo:
    """Description of an exported file.

    Attributes:
        file: the file.
        sha256: of the file that has the weights.
        kind: `onnx`, `openvino`, `tensorrt`, `torchscript`, or `checkpoint` (YOLOX).
        written_by: the exporting program, as far as known.
        task: of the network, see `TASKS`; only the boxes are used.
        layout, layout_text: of its outputs, by name and in words.
        stride: the sides of the input are multiples of it, pixels.
        input_size: (height, width) of the only accepted input; None: any.
        classes: id → name.
        names_from: where the class names are from.
        licence: as stated in the file; None if missing.
        runtime, runtime_reason, precision: on this computer.
        stated: further metadata in the file.
    """

    file: str
    sha256: str
    kind: str
    written_by: str
    task: str
    layout: str
    layout_text: str
    stride: int
    input_size: tuple[int, int] | None
    classes: tuple[str, ...]
    names_from: str
    licence: str | None
    runtime: str
    runtime_reason: str
    precision: str
    stated: dict[str, Any]

    def plain(self) -> dict[str, Any]:
        return asdict(self)


def export_info(source: ModelSource, image_size: int, runtime: RuntimeChoice | None) -> ExportInfo:
    """Describe an exported file, and load it to determine its precision on this computer.

    Raises:
        RuntimeUnusableError: the runtime is missing or does not run the file.
    """
    detector = Detector(source.path, image_size=image_size, runtime=runtime)
    stated = dict(source.metadata)
    licence = stated.pop("licence", None)
    found = detector.foreign
    return ExportInfo(
        file=str(source.path),
        sha256=weights_sha256(source.weights_path),
        kind=source.kind or "checkpoint",
        written_by="companion models export" if found is None else found.written_by,
        task="detect" if found is None else found.task,
        layout="levels" if found is None else found.layout,
        layout_text="raw outputs of each level" if found is None else LAYOUTS[found.layout],
        stride=max(source.strides),
        input_size=source.facts.fixed_size if source.facts else (found.fixed_size if found else None),
        classes=source.class_names,
        names_from="its metadata" if found is None else found.names_from,
        licence=None if licence is None else str(licence),
        runtime=detector.runtime,
        runtime_reason=detector.runtime_reason,
        precision=f"{detector.precision} ({detector.precision_reason})",
        stated=stated,
    )


def export_lines(info: ExportInfo) -> list[str]:
    """Return the description as text lines."""
    shown = ", ".join(info.classes[:12]) + (", …" if len(info.classes) > 12 else "")
    size = "any" if info.input_size is None else f"{info.input_size[1]}x{info.input_size[0]}"
    note = TASKS[info.task]
    rows = {
        "file": info.file,
        "sha256": info.sha256,
        "written by": f"{info.written_by}, as {info.kind}",
        "task": f"{info.task}; {note}" if note else info.task,
        "outputs": f"{info.layout}: {info.layout_text}",
        "input": f"{size}, stride {info.stride}",
        "classes": f"{len(info.classes)} (from {info.names_from}): {shown}",
        "runs here": f"on {info.runtime} ({info.runtime_reason})",
        "precision": info.precision,
        "licence": info.licence or "not stated in the file",
        **{key: str(value) for key, value in info.stated.items() if isinstance(value, str | int | float)},
    }
    width = max(map(len, rows))
    return [f"{name:<{width}}  {value}" for name, value in rows.items()]
