"""`mavlink-sim dataset`: write labelled images to a folder."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import cv2
import typer
from rich.console import Console
from rich.progress import Progress

from mavlink_sim.camera.scene_file import SceneError, load_scene
from mavlink_sim.datasets.dataset import RANDOM_SIZE, DatasetError, DatasetOptions, make_dataset
from mavlink_sim.world.shapes import CLASS_NAMES

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


class Layout(StrEnum):
    """The format of the labels."""

    YOLO = "yolo"
    COCO = "coco"


@app.command()
def dataset(
    out: Annotated[Path, typer.Argument(help="Folder to write to: new or empty.")],
    frames: Annotated[int, typer.Option(help="Number of images.")] = 100,
    scene: Annotated[
        str, typer.Option(help="A scene file, the name of a bundled scene, or random: the training scenes.")
    ] = "random",
    layout: Annotated[Layout, typer.Option("--format", help="Format of the labels.")] = Layout.YOLO,
    seed: Annotated[int, typer.Option(help="The same seed gives the same images.")] = 0,
    depth: Annotated[
        bool, typer.Option("--depth", help="Also write depth: 16-bit PNG in millimetres.")
    ] = False,
    classes: Annotated[str, typer.Option(help="Classes to label, separated by commas.")] = ",".join(
        CLASS_NAMES
    ),
    validation: Annotated[float, typer.Option(help="Share of the images for validation.")] = 0.1,
    min_visible: Annotated[
        float, typer.Option(help="Minimum visible fraction of a labelled object, 0 to 1.")
    ] = 0.3,
    min_side: Annotated[float, typer.Option(help="Minimum side of a labelled box, pixels.")] = 6.0,
    lowest: Annotated[float, typer.Option(help="Minimum camera height, m; with --scene FILE.")] = 1.5,
    highest: Annotated[float, typer.Option(help="Maximum camera height, m; with --scene FILE.")] = 40.0,
    width: Annotated[int, typer.Option(help="Image width, pixels; with --scene random.")] = RANDOM_SIZE[0],
    height: Annotated[int, typer.Option(help="Image height, pixels; with --scene random.")] = RANDOM_SIZE[1],
) -> None:
    """Write labelled images of a scene, or of random ones, for training and testing detectors."""
    cv2.setNumThreads(1)
    try:
        options = DatasetOptions(
            frames=frames,
            seed=seed,
            layout=layout.value,
            classes=tuple(name.strip() for name in classes.split(",") if name.strip()),
            depth=depth,
            validation=validation,
            min_visible=min_visible,
            min_side_px=min_side,
            altitude_m=(lowest, highest),
            size=(width, height),
        )
        chosen = None if scene == "random" else load_scene(scene)
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("images", total=frames)
            labels = make_dataset(out, chosen, options, lambda done: progress.update(task, completed=done))
    except (DatasetError, SceneError, OSError) as error:
        print(f"mavlink-sim: {error}", file=sys.stderr)
        raise typer.Exit(2) from None
    print(f"{out}: {frames} images, {labels} labels")
