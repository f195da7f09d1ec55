"""The command line of `companion evaluate`."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.flags import plain_errors
from companion.host.journal import log_to_standard_error


def evaluate(
    dataset: Annotated[Path, typer.Argument(help="YOLO-format folder, data.yaml or COCO JSON.")],
    model: Annotated[str, typer.Option(help="Checkpoint, or name in the models folder.")] = "default",
    split: Annotated[
        str | None, typer.Option(help="Split of a data.yaml: train, val or test. Default: val.")
    ] = None,
    images: Annotated[Path | None, typer.Option(help="Image folder of a COCO file.")] = None,
    image_size: Annotated[
        int, typer.Option(min=32, help="Longer side of the network's input, pixels.")
    ] = 640,
    iou: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="NMS IoU threshold. Default: that of the model, else 0.7."),
    ] = None,
    runtime: Annotated[
        str | None,
        typer.Option(
            help="Runtime: torch, onnxruntime, openvino, tensorrt or auto. Default: that of the file, "
            "torch for a checkpoint."
        ),
    ] = None,
    precision: Annotated[
        str | None,
        typer.Option(
            help="Precision: auto, float32, bfloat16 or float16. Default: float32, or auto for an int8 file."
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="Device of torch: cpu or cuda.")] = "cpu",
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads of the network.")] = None,
    tiles: Annotated[
        bool, typer.Option("--tiles", help="Process images in tiles too, as `detect --tiles`.")
    ] = False,
    tile_size: Annotated[int, typer.Option(min=64, help="Side of a tile, pixels of the image.")] = 640,
    tile_overlap: Annotated[
        float, typer.Option(min=0, max=0.8, help="Overlap of tiles, fraction of a tile.")
    ] = 0.2,
    limit: Annotated[int | None, typer.Option(min=1, help="Maximum number of images.")] = None,
    misses: Annotated[Path, typer.Option(help="Output image of the worst misses.")] = Path("misses.png"),
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Evaluate a model on a labelled data set. Prints mAP50 and mAP50-95, overall and per class."""
    from companion.learning.evaluate import (
        JUDGED_CONFIDENCE,
        evaluate_dataset,
        map_classes,
        report_lines,
        usual_precision,
        write_sheet,
    )
    from vision.detector import Detector
    from vision.evaluation.datasets import DatasetError, open_dataset
    from vision.pipeline import FrameDetector
    from vision.tiling import TiledDetector
    from vision.yolo.checkpoint_error import CheckpointError

    log_to_standard_error(logging.INFO, "%(message)s")
    with plain_errors(CheckpointError, DatasetError, ValueError, OSError):
        data = open_dataset(dataset, split=split, images=images)
        if limit is not None:
            data = replace(data, samples=data.samples[:limit])
        detector = Detector(
            model,
            confidence=JUDGED_CONFIDENCE,
            iou=iou,
            image_size=image_size,
            precision=precision or usual_precision(model),  # type: ignore[arg-type]
            device=device,  # type: ignore[arg-type]
            threads=threads,
            runtime=runtime,  # type: ignore[arg-type]
        )
        frame_detector: FrameDetector = detector
        if tiles:
            frame_detector = TiledDetector(detector, tile_size=tile_size, overlap=tile_overlap)
        evaluation = evaluate_dataset(data, frame_detector, map_classes(detector.class_names, data))
        has_sheet = write_sheet(evaluation, misses)
    if as_json:
        settings = {
            "model": model,
            "dataset": str(dataset),
            "image_size": image_size,
            "runtime": detector.runtime,
            "precision": detector.precision,
            "tiles": tiles,
        }
        sheet = str(misses) if has_sheet else None
        typer.echo(json.dumps({**settings, **evaluation.plain(), "misses_image": sheet}))
        return
    for line in report_lines(evaluation):
        typer.echo(line)
    if has_sheet:
        typer.echo(f"worst misses: {misses}")
