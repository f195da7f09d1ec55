"""The command line of `companion cloud`."""

from __future__ import annotations

import json
import logging
import math
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer

from companion.cli.cameras import opened
from companion.cli.flags import EXIT_BAD_INPUT, check_finite, check_folder, plain_errors
from vision.gc_pause import gc_paused

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from companion.settings import Settings
    from companion.settings.perception import CameraSection
    from vision.frame import Frame
    from vision.point_cloud import Cluster

logger = logging.getLogger(__name__)

CLOUD_SETTINGS = ("camera", "source", "plugins")
# Of a source whose depth is paired with its images, the first frames may have none.
_DEPTH_TIMEOUT_S = 2.0
# A greater share of points below the plane: it cuts through what it should lie under.
_BELOW_GROUND = 0.05
_VIEW_SUFFIXES, _JPEG_QUALITY = (".png", ".jpg"), 80


def cloud(
    settings: Settings,
    source: Annotated[str, typer.Argument(help="Source with depth, or with --source-depth.")],
    output: Annotated[Path, typer.Argument(help="Output file: .ply or .pcd.")],
    frame: Annotated[
        Literal["camera", "body", "ned"], typer.Option(help="Frame of the points; NED is from the vehicle.")
    ] = "body",
    attitude: Annotated[
        tuple[float, float, float],
        typer.Option(help="The vehicle's roll, pitch and yaw, degrees.", metavar="ROLL PITCH YAW"),
    ] = (0.0, 0.0, 0.0),
    max_range: Annotated[float, typer.Option(min=0.1, help="Maximum depth, metres.")] = 20.0,
    voxel: Annotated[
        float | None, typer.Option(min=0.005, max=10, help="Voxel grid: one point per cube, metres.")
    ] = None,
    average: Annotated[
        int | None,
        typer.Option(min=1, max=32, help="Make one point of N x N pixels, against a stereo camera's noise."),
    ] = None,
    clusters: Annotated[
        bool,
        typer.Option(
            "--clusters", help="List the objects above the ground. Unless set: --voxel 0.1 --average 4."
        ),
    ] = False,
    view: Annotated[
        Path | None, typer.Option(help="View of the cloud from behind and above: .png or .jpg.")
    ] = None,
    text: Annotated[bool, typer.Option("--text", help="Write numbers as text instead of binary.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write one frame's depth as a point cloud.

    The points have the colours of its image.
    """
    with gc_paused():
        import cv2
        import numpy as np

        from vision.point_cloud import CloudFileError, cloud_from_depth, scene_of, voxel_grid, write_cloud
        from vision.point_cloud.drawing import draw_cloud
        from vision.rotation import matrix_from_euler

    if view is not None and view.suffix not in _VIEW_SUFFIXES:
        _refuse(f"{view}: expected a name that ends in {' or '.join(_VIEW_SUFFIXES)}")
    if clusters:
        voxel, average = voxel or 0.1, average or 4
    # ValueError: a camera on a gimbal has no fixed mount, or the voxels are too small.
    with plain_errors(CloudFileError, ValueError, OSError):
        check_finite("--attitude", *attitude)
        for path in (output, view):
            if path is not None:
                check_folder(path)
        ned_from_body = matrix_from_euler(*(math.radians(angle) for angle in attitude))
        captured, depth_m, camera = _capture(settings, source)
        mount = camera.mount()
        points = cloud_from_depth(
            depth_m,
            camera.model(captured.width, captured.height),
            image=captured.image,
            frame=frame,
            mount=mount,
            ned_from_body=ned_from_body,
            range_m=(0.0, max_range),
            average=average or 1,
            stamp_ns=captured.captured_ns,
        )
        if not len(points):
            _refuse(f"{source}: the cloud is empty: no pixel has a depth of up to {max_range:g} m")
        down = np.array([0.0, 0.0, 1.0])
        if frame == "body":
            down = ned_from_body[2]
        elif frame == "camera":
            # A gimbal's attitude is unknown here: as if it were at rest.
            held = mount.held(ned_from_body) if mount.on_gimbal else mount
            down = held.ned_from_optical(ned_from_body)[2]
        written = points
        found: list[Cluster] = []
        if clusters and voxel is not None:
            scene = scene_of(points, down, voxel_m=voxel)
            written, found = scene.voxels, scene.clusters
            below = scene.ground is None or scene.ground.heights_m(written.points) < -3.0 * voxel
            if np.mean(below) > _BELOW_GROUND:
                typer.echo(
                    f"companion: {source}: no level ground found, so the ground may be among the objects: "
                    "give the vehicle's --attitude, or camera.mount_pitch_deg",
                    err=True,
                )
        elif voxel is not None:
            written = voxel_grid(points, voxel)
        write_cloud(output, written, binary=not text)
        if view is not None:
            drawn = draw_cloud(written, down, clusters=found, point_m=0.03 if voxel is None else voxel)
            quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if view.suffix == ".jpg" else []
            if not cv2.imwrite(str(view), drawn, quality):
                raise OSError(f"cannot write {view}: check its folder and the free disk space")
    objects = [_record(cluster, down) for cluster in found]
    if as_json:
        report = {"source": source, "file": str(output), "frame": frame, "stamp_ns": points.stamp_ns}
        report |= {"points": len(written)}
        print(json.dumps(report | ({"clusters": objects} if clusters else {})))
        return
    print(f"{output}: {len(written)} points, frame {frame}")
    for each in objects:
        size = " x ".join(f"{side:.1f}" for side in each["size_m"])
        print(f"{each['range_m']:6.1f} m  {size} m  {each['points']} points")


def _capture(settings: Settings, uri: str) -> tuple[Frame, NDArray[np.float32], CameraSection]:
    """The source's first frame with depth, its depth, and its camera."""
    from companion.settings.calibration import adopt_calibration
    from vision.sources import EndOfStream

    camera = settings.camera
    with opened(settings, uri) as frames:
        if frames.calibration is not None:
            camera, conflict = adopt_calibration(camera, frames.calibration)
            if conflict:
                logger.warning("camera: settings override the camera's calibration: %s", conflict)
        end_s = time.monotonic() + _DEPTH_TIMEOUT_S
        with suppress(EndOfStream):
            while time.monotonic() < end_s:
                captured = frames.read(_DEPTH_TIMEOUT_S / 4)
                if captured is not None and captured.depth_m is not None:
                    return captured, captured.depth_m, camera
    _refuse(f"{uri}: its frames have no depth: use a source with depth (shm://NAME), or set source.depth")


def _record(cluster: Cluster, down: NDArray[np.float64]) -> dict[str, Any]:
    """One object above the ground, as JSON-able data."""
    import numpy as np

    centre = cluster.centre_m
    level = centre - (centre @ down) * down
    numbers: dict[str, NDArray[Any]] = {
        "centre_m": centre,
        "size_m": cluster.size_m,
        "axes": cluster.axes.T,  # one axis in each row
        "low_m": cluster.low_m,
        "high_m": cluster.high_m,
    }
    return {
        "points": len(cluster),
        "range_m": round(float(np.linalg.norm(level)), 3),
        **{name: np.round(values.astype(np.float64), 4).tolist() for name, values in numbers.items()},
    }


def _refuse(text: str) -> NoReturn:
    typer.echo(f"companion: {text}", err=True)
    raise typer.Exit(EXIT_BAD_INPUT)
