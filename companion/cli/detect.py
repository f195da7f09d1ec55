"""The command line of `companion detect`."""

from __future__ import annotations

import functools
import logging
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.download import Pull, model_after_pull
from companion.cli.flags import EXIT_BAD_INPUT, YOLO, plain_errors, warn_rendered_only
from companion.host.journal import log_to_standard_error
from vision.gc_pause import gc_paused


def detect(
    source: Annotated[
        str, typer.Argument(help="File, folder, /dev/video0, FIFO, - (standard input) or URL.")
    ],
    detector_kind: Annotated[str, typer.Option(help="Detector kind: yolo, or that of a plug-in.")] = YOLO,
    model: Annotated[
        str, typer.Option(help="Checkpoint, exported file, or name in the models folder.")
    ] = "default",
    classes: Annotated[
        str | None, typer.Option(help="Classes to detect: names or ids, comma separated. Default: all.")
    ] = None,
    confidence: Annotated[float, typer.Option(min=0, max=1, help="Confidence threshold.")] = 0.25,
    iou: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="NMS IoU threshold. Default: that of the model, else 0.7."),
    ] = None,
    image_size: Annotated[
        int, typer.Option(min=32, help="Longer side of the network's input, pixels.")
    ] = 640,
    runtime: Annotated[
        str | None,
        typer.Option(
            help="Runtime: torch, onnxruntime, openvino, tensorrt or auto. Default: that of the file, "
            "torch for a checkpoint."
        ),
    ] = None,
    precision: Annotated[str, typer.Option(help="Precision: auto, float32, bfloat16 or float16.")] = "auto",
    device: Annotated[str, typer.Option(help="Device of torch: cpu or cuda.")] = "cpu",
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads of the network.")] = None,
    retune: Annotated[
        bool, typer.Option("--retune", help="Measure this model's runtimes and precisions again.")
    ] = False,
    every: Annotated[int, typer.Option(min=1, help="Process every Nth frame.")] = 1,
    limit: Annotated[int | None, typer.Option(min=1, help="Maximum number of frames.")] = None,
    tiles: Annotated[
        bool, typer.Option("--tiles", help="Process large frames in tiles too: small objects, much slower.")
    ] = False,
    tile_size: Annotated[int, typer.Option(min=64, help="Side of a tile, pixels of the frame.")] = 640,
    tile_overlap: Annotated[
        float, typer.Option(min=0, max=0.8, help="Overlap of tiles, fraction of a tile.")
    ] = 0.2,
    track: Annotated[bool, typer.Option("--track", help="Enable multi-object tracking.")] = False,
    save: Annotated[Path | None, typer.Option(help="Folder for input and annotated images.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per frame.")] = False,
    width: Annotated[int | None, typer.Option(min=1, help="Width of raw frames or a camera, pixels.")] = None,
    height: Annotated[
        int | None, typer.Option(min=1, help="Height of raw frames or a camera, pixels.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.1, help="Frame rate of a camera or raw file, Hz.")
    ] = None,
    pixel_format: Annotated[
        str | None, typer.Option(help="Pixel format: bgr24, rgb24, gray8, yuv420, y4m, mjpeg, YUYV…")
    ] = None,
    plugins_modules: Annotated[
        str | None, typer.Option(help="Plug-ins to load: modules or names, comma separated.")
    ] = None,
    pull: Pull = False,
) -> None:
    """Detect objects in the frames of a source. Prints a line per frame, and a summary on standard error.

    A live image in the browser: companion view SOURCE.
    """
    with gc_paused():
        from companion.camera_tools.detect import detect_source, make_save_folder
        from companion.settings.plugins import PluginError, load_plugins
        from vision.detector import forget_measurements, open_detector
        from vision.object_detector import DetectionsError, DetectorSettings
        from vision.pipeline import FrameDetector
        from vision.runtimes.base import RuntimeUnusableError
        from vision.sources import SourceError, SourceSettings, open_source
        from vision.tiling import TiledDetector
        from vision.tracking import Tracker, TrackerSettings

    log_to_standard_error(logging.WARNING, "companion: %(message)s")
    tracking = TrackerSettings(keep_confidence=confidence)
    with plain_errors(PluginError, OSError, ValueError):  # CheckpointError is a ValueError
        if save is not None:
            make_save_folder(save, source)
        load_plugins(parse_words(plugins_modules))
        if pull:
            model = model_after_pull(model, [source])
        wanted = DetectorSettings(
            model,
            classes=parse_classes(classes),
            # A tracker also uses weak detections, and drops those without a track.
            confidence=min(confidence, tracking.low_confidence) if track else confidence,
            iou=iou,
            image_size=image_size,
            precision=precision,  # type: ignore[arg-type]
            device=device,  # type: ignore[arg-type]
            threads=threads,
            runtime=runtime,  # type: ignore[arg-type]
        )
        if retune and detector_kind == YOLO:
            forget_measurements(model)
        detector = open_detector(detector_kind, wanted)
        if runtime == "auto" and detector.runtime is not None:
            typer.echo(f"companion: on {detector.runtime} ({detector.reason})", err=True)
        frame_detector: FrameDetector = detector
        if tiles:
            frame_detector = TiledDetector(detector, tile_size=tile_size, overlap=tile_overlap)
        settings = SourceSettings(
            width=width, height=height, rate_hz=rate, pixel_format=pixel_format, every_frame=True
        )
    write = functools.partial(print, flush=True)
    unusable = (SourceError, OSError, RuntimeUnusableError, DetectionsError)
    with plain_errors(*unusable), open_source(source, settings) as frames:
        if detector.rendered_only:
            warn_rendered_only([(source, detector.model_name)])
        summary = detect_source(
            frames,
            frame_detector,
            every=every,
            limit=limit,
            save=save,
            as_json=as_json,
            tracker=Tracker(tracking) if track else None,
            write=write,
        )
    if not summary.frames:
        typer.echo(f"companion: {source}: contains no frames", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    typer.echo(f"companion: {summary}", err=True)


def parse_words(text: str | None) -> list[str]:
    """Split `a, b` into a list; empty for None."""
    return [word.strip() for word in (text or "").split(",") if word.strip()]


def parse_classes(text: str | None) -> tuple[str | int, ...] | None:
    """Parse `person,car` or `0,2` into class names and ids; None for all."""
    if text is None or not text.strip():
        return None
    return tuple(int(word) if word.isdigit() else word for word in parse_words(text))
