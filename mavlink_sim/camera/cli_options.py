"""Options of the camera that `mavlink-sim` and `mavlink-sim camera` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

SceneName = Annotated[
    str | None,
    typer.Option(
        help="TOML file with world, obstacles and camera, or the name of a bundled scene; the camera's "
        "default is the demo world."
    ),
]
CameraRate = Annotated[
    float | None, typer.Option(help="Frames per second, 1 to 120; default: the scene's, else 30.")
]
CameraOutputs = Annotated[
    list[str] | None,
    typer.Option(
        help="Also send frames to pipe:PATH, pipe:-, http://HOST:PORT or rtp://HOST:PORT; repeatable."
    ),
]
CameraTruth = Annotated[
    Path | None,
    typer.Option(help="Write the objects in each frame to this file, one JSON object per line."),
]
