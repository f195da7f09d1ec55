"""The point cloud of `companion detect --cloud`: one frame's depth, with the colours of its image."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.camera_tools.cloud_drawing import draw_cloud
from companion.camera_tools.detect import PlainPart, Seen, Shown
from companion.settings.perception import CameraSection
from vision.point_cloud import (
    CloudFrame,
    Cluster,
    PointCloud,
    cloud_from_depth,
    scene_of,
    voxel_grid,
    write_cloud,
)

logger = logging.getLogger(__name__)

# A greater share of points below the plane: it cuts through what it should lie under.
_BELOW_GROUND = 0.05
VIEW_SUFFIXES, _JPEG_QUALITY = (".png", ".jpg"), 80


@dataclass(frozen=True, slots=True)
class CloudOptions:
    """What is written.

    Attributes:
        output: .ply or .pcd. frame: of the points.
        ned_from_body: (3, 3), the vehicle's attitude.
        max_range_m: greatest depth. voxel_m: one point per cube of this side; None: all.
        average: one point of so many pixels in a square.
        clusters: also the objects above the ground; needs `voxel_m`.
        view: image of the cloud from behind and above.
        as_text: numbers as text instead of binary.
    """

    output: Path
    frame: CloudFrame
    ned_from_body: NDArray[np.float64]
    max_range_m: float
    voxel_m: float | None
    average: int
    clusters: bool
    view: Path | None
    as_text: bool


class Cloud(PlainPart):
    """Writes the first frame with depth as a point cloud; the loop ends after it."""

    needs_depth = True
    ends = True

    def __init__(self, source: str, camera: CameraSection, options: CloudOptions) -> None:
        self._source, self._camera, self._options = source, camera, options

    def show(self, seen: Seen) -> Shown:
        """Write the cloud and its view.

        Raises:
            ValueError: the cloud is empty, the voxels are too small, or a camera on a gimbal has no fixed
                mount.
            CloudFileError, OSError: a file cannot be written.
        """
        options, captured = self._options, seen.frame
        assert captured.depth_m is not None
        points = cloud_from_depth(
            captured.depth_m,
            self._camera.model(captured.width, captured.height),
            image=captured.image,
            frame=options.frame,
            mount=self._camera.mount(),
            ned_from_body=options.ned_from_body,
            range_m=(0.0, options.max_range_m),
            average=options.average,
            stamp_ns=captured.captured_ns,
        )
        if not len(points):
            raise ValueError(
                f"{self._source}: the cloud is empty: no pixel has a depth of up to {options.max_range_m:g} m"
            )
        down = self._down()
        written, found = self._reduced(points, down)
        write_cloud(options.output, written, binary=not options.as_text)
        if options.view is not None:
            _write_view(options.view, written, down, found, options.voxel_m)
        objects = [_record(cluster, down) for cluster in found]
        cloud = {"file": str(options.output), "frame": options.frame, "points": len(written)}
        lines = [f"{options.output}: {len(written)} points, frame {options.frame}"]
        for each in objects:
            size = " x ".join(f"{side:.1f}" for side in each["size_m"])
            lines.append(f"{each['range_m']:6.1f} m  {size} m  {each['points']} points")
        return Shown({"cloud": cloud | ({"clusters": objects} if options.clusters else {})}, lines)

    def _down(self) -> NDArray[np.float64]:
        """Which way is down in the frame of the points."""
        ned_from_body = self._options.ned_from_body
        down: NDArray[np.float64] = ned_from_body[2]
        if self._options.frame == "body":
            return down
        if self._options.frame == "ned":
            return np.array([0.0, 0.0, 1.0])
        mount = self._camera.mount()
        # A gimbal's attitude is unknown here: as if it were at rest.
        held = mount.held(ned_from_body) if mount.on_gimbal else mount
        down = held.ned_from_optical(ned_from_body)[2]
        return down

    def _reduced(self, points: PointCloud, down: NDArray[np.float64]) -> tuple[PointCloud, list[Cluster]]:
        """The points to write, and the objects above the ground."""
        voxel_m = self._options.voxel_m
        if voxel_m is None:
            return points, []
        if not self._options.clusters:
            return voxel_grid(points, voxel_m), []
        scene = scene_of(points, down, voxel_m=voxel_m)
        below = scene.ground is None or scene.ground.heights_m(scene.voxels.points) < -3.0 * voxel_m
        if np.mean(below) > _BELOW_GROUND:
            logger.warning(
                "%s: no level ground found, so the ground may be among the objects: give the vehicle's "
                "--attitude, or camera.mount_pitch_deg",
                self._source,
            )
        return scene.voxels, scene.clusters


def _write_view(
    path: Path, cloud: PointCloud, down: NDArray[np.float64], found: list[Cluster], voxel_m: float | None
) -> None:
    drawn = draw_cloud(cloud, down, clusters=found, point_m=0.03 if voxel_m is None else voxel_m)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if path.suffix == ".jpg" else []
    if not cv2.imwrite(str(path), drawn, quality):
        raise OSError(f"cannot write {path}: check its folder and the free disk space")


def _record(cluster: Cluster, down: NDArray[np.float64]) -> dict[str, Any]:
    """One object above the ground, as JSON-able data."""
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
