"""Opens a labelled data set of any supported format."""

from __future__ import annotations

from pathlib import Path

from vision.evaluation.coco_dataset import find_annotations, read_coco
from vision.evaluation.samples import Dataset, DatasetError
from vision.evaluation.yolo_dataset import read_yolo


def open_dataset(path: Path, *, split: str | None = None, images: Path | None = None) -> Dataset:
    """Detect the format of the data set at `path` and read its labels.

    Args:
        path: a folder with `images/` and `labels/`, or with both side by side; one with a `data.yaml`, or
            that file; a COCO annotation file (JSON), or a folder with one.
        split: `train`, `val` or `test` of a `data.yaml`; None: `val`, or the first other one.
        images: folder of a COCO file's images; None: searched near the file.

    Raises:
        DatasetError: no data set found, or an invalid label.
    """
    if not path.exists():
        raise DatasetError(
            f"{path}: no such file or folder; give a data set's folder, data.yaml or COCO JSON"
        )
    annotations = path if path.suffix.lower() == ".json" else find_annotations(path)
    if annotations is not None:
        return read_coco(annotations, images)
    return read_yolo(path, split)
