"""Images of a calibration board through any lens, with their truth: a calibration without a printer.

Each pixel is the mean over rays through it, intersected with the board, so that corners are geometrically
exact for every distortion model, also a fisheye's beyond 180 degrees, which the world's renderer cannot show.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from vision.calibration.boards import Board
from vision.calibration_files.camera_info import read_camera_info, write_camera_info
from vision.camera_model import CameraModel
from vision.depth_registration import DepthCalibration
from vision.rotation import matrix_from_euler

Array = NDArray[np.float64]

SAMPLES = 4
"""Rays per pixel and axis."""
_SQUARE_PX = 120
_BLACK, _WHITE = 25.0, 215.0
_MAX_TRIES = 500
LENSES: dict[str, CameraModel] = {
    "plain": CameraModel(640, 480, 520.0, 520.0, 319.5, 239.5),
    "webcam": CameraModel(640, 480, 498.0, 499.0, 326.0, 233.0, (-0.28, 0.09, 0.0008, -0.0006, -0.01)),
    "wide": CameraModel(
        *(640, 480, 330.0, 331.0, 318.0, 242.0),
        (0.6, 0.08, 0.0004, -0.0003, 0.002, 0.92, 0.22, 0.012),
        "rational_polynomial",
    ),
    "fisheye": CameraModel(
        *(640, 480, 240.0, 240.5, 321.0, 238.0), (-0.02, 0.004, -0.002, 0.0003), "equidistant"
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """Pose of a board: `optical_from_board` (3, 3), and its origin in the optical frame (3,), metres."""

    rotation: Array
    position_m: Array

    def project(self, board: Board, camera: CameraModel) -> Array:
        """(N, 2) pixels of the board's inner corners."""
        points = np.column_stack([board.points_m, np.zeros(len(board.points_m))])
        return camera.project(points @ self.rotation.T + self.position_m)

    def within(self, board: Board, camera: CameraModel) -> bool:
        """Whether all of the board's squares are within the image."""
        half = np.array(board.size_m) / 2
        outline = np.array([(x, y, 0.0) for x in (-1, 0, 1) for y in (-1, 0, 1)]) * (*half, 1.0)
        seen = camera.project(outline @ self.rotation.T + self.position_m)
        return bool((seen > 3).all() and (seen < (camera.width - 4, camera.height - 4)).all())


class BoardCamera:
    """Renders one board through one lens.

    Args:
        noise: standard deviation of the sensor's noise, grey levels. blur_px: of the lens.
    """

    def __init__(self, board: Board, camera: CameraModel, noise: float = 2.0, blur_px: float = 0.5) -> None:
        self.board, self.camera = board, camera
        self._noise, self._blur_px = noise, blur_px
        self._print = np.pad(board.image(_SQUARE_PX), _SQUARE_PX // 2, constant_values=128)
        # Between pixels the rays are interpolated, which is exact to a thousandth of a pixel.
        pixels = np.stack(
            np.meshgrid(np.arange(-1, camera.width + 1), np.arange(-1, camera.height + 1)), axis=-1
        )
        rays = camera.rays(pixels.reshape(-1, 2)).astype(np.float32).reshape(*pixels.shape[:2], 3)
        rays = np.asarray(cv2.resize(rays, None, fx=SAMPLES, fy=SAMPLES, interpolation=cv2.INTER_LINEAR))
        self._rays = rays[SAMPLES:-SAMPLES, SAMPLES:-SAMPLES]

    def render(self, pose: BoardPose, rng: np.random.Generator) -> NDArray[np.uint8]:
        """(H, W) uint8 grey image."""
        camera, high = self.camera, SAMPLES * self.camera.height
        rotation, position = pose.rotation, pose.position_m
        # A ray meets the board's plane at ray * (n . t) / (n . ray); its coordinates there, in the print's
        # pixels, as a homography of the ray.
        reach = float(rotation[:, 2] @ position)
        axes = [
            reach * rotation[:, axis] - (rotation[:, axis] @ position) * rotation[:, 2] for axis in (0, 1)
        ]
        size = np.array(self._print.shape[::-1], np.float64)
        scale, centre = _SQUARE_PX / self.board.square_m, (size - 1) / 2
        rows = [axis * scale + middle * rotation[:, 2] for axis, middle in zip(axes, centre, strict=True)]
        homography = np.array([*rows, rotation[:, 2]], np.float32)
        light = _light(rng, camera)
        image = np.empty((camera.height, camera.width), np.float32)
        step = SAMPLES * 40
        for top in range(0, high, step):
            across, down, depth = np.moveaxis(self._rays[top : top + step] @ homography.T, -1, 0)
            with np.errstate(all="ignore"):
                map_x, map_y = across / depth, down / depth
            # Behind the camera, and where the lens has no rays.
            hidden = ~(depth * np.float32(math.copysign(1.0, reach)) > 1e-6)
            map_x[hidden] = -10.0
            looked = cv2.remap(
                self._print, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128
            )
            looked = looked.astype(np.float32) / np.float32(255.0)
            mean = looked.reshape(-1, SAMPLES, camera.width, SAMPLES).mean(axis=(1, 3))
            image[top // SAMPLES : top // SAMPLES + len(mean)] = mean
        image = (_BLACK + (_WHITE - _BLACK) * image) * light
        if self._blur_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self._blur_px), np.float32)
        image += rng.normal(0.0, self._noise, image.shape).astype(np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def board_poses(board: Board, camera: CameraModel, rng: np.random.Generator) -> Iterator[BoardPose]:
    """Random poses as a person holds a board: all over the image, near and far, tilted to all sides.

    All of the board's squares are within the image. Raises ValueError where no such pose is found.
    """
    while True:
        for _ in range(_MAX_TRIES):
            pixel = rng.beta(0.6, 0.6, 2) * (camera.width, camera.height)
            ray = camera.rays(pixel[None])[0]
            if not np.isfinite(ray).all():
                continue
            share = math.exp(rng.uniform(math.log(0.3), math.log(0.9)))
            range_m = board.size_m[0] * (camera.fx + camera.fy) / 2 / (share * camera.width)
            facing = _facing(ray)
            tilt = matrix_from_euler(0.0, 0.0, rng.uniform(-math.pi, math.pi))
            lean = matrix_from_euler(rng.uniform(math.radians(8.0), math.radians(45.0)), 0.0, 0.0)
            turn = matrix_from_euler(0.0, 0.0, rng.normal(0.0, math.radians(15.0)))
            rotation = facing @ tilt @ lean @ tilt.T @ turn
            pose = BoardPose(rotation, ray * range_m)
            if pose.within(board, camera):
                yield pose
                break
        else:
            raise ValueError(f"no pose of the board was found within {camera.width}x{camera.height}")


def random_rig(colour: CameraModel, depth: CameraModel, rng: np.random.Generator) -> DepthCalibration:
    """A depth camera some centimetres beside a colour camera, turned by up to 3 degrees about each axis."""
    rotation = matrix_from_euler(*np.radians(rng.uniform(-3.0, 3.0, 3)))
    position = rng.uniform((-0.08, -0.02, -0.02), (0.08, 0.02, 0.02))
    return DepthCalibration(depth, colour, rotation, position)


def board_pairs(
    board: Board, rig: DepthCalibration, rng: np.random.Generator
) -> Iterator[tuple[BoardPose, BoardPose]]:
    """Random poses of a board in the colour camera and in the depth camera, within both images."""
    narrow = min(rig.depth, rig.colour, key=lambda lens: lens.horizontal_fov_rad)
    while True:
        for _, pose in zip(range(_MAX_TRIES), board_poses(board, narrow, rng), strict=False):
            if narrow is rig.depth:
                turned = BoardPose(
                    rig.rotation @ pose.rotation, rig.rotation @ pose.position_m + rig.position_m
                )
                pair = turned, pose
            else:
                back = rig.rotation.T
                pair = pose, BoardPose(back @ pose.rotation, back @ (pose.position_m - rig.position_m))
            if pair[0].within(board, rig.colour) and pair[1].within(board, rig.depth):
                yield pair
                break
        else:
            raise ValueError("no pose of the board was found within the images of both cameras")


def _facing(ray: Array) -> Array:
    """(3, 3) the shortest rotation of the optical axis to a ray."""
    axis = np.cross((0.0, 0.0, 1.0), ray)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return np.asarray(cv2.Rodrigues(axis / sine * math.atan2(sine, float(ray[2])))[0], np.float64)


def _light(rng: np.random.Generator, camera: CameraModel) -> NDArray[np.float32]:
    """(H, W) brightness: uneven light from one side."""
    slope = rng.uniform(-0.15, 0.15, 2)
    across, down = np.linspace(-1, 1, camera.width), np.linspace(-1, 1, camera.height)
    light = rng.uniform(0.75, 1.0) * (1.0 + slope[0] * across + slope[1] * down[:, None])
    return np.asarray(light, np.float32)


def write_board_views(folder: Path, board: Board, camera: CameraModel, views: int, seed: int) -> None:
    """Write `view00.png`, …, `truth.yaml` (the lens) and `truth.json` (the board's poses).

    Raises:
        ValueError: the folder is not empty, or no pose shows the whole board.
        OSError: a file cannot be written.
    """
    _make_empty(folder)
    rng = np.random.default_rng(seed)
    renderer = BoardCamera(board, camera)
    poses = board_poses(board, camera, rng)
    truth = []
    for number in range(views):
        pose, name = next(poses), f"view{number:02d}.png"
        _save(folder / name, renderer.render(pose, rng))
        truth.append(
            {
                "image": name,
                "optical_from_board": pose.rotation.tolist(),
                "position_m": pose.position_m.tolist(),
            }
        )
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", "utf-8")
    write_camera_info(folder / "truth.yaml", camera, "truth")


def write_board_pairs(
    folder: Path, board: Board, colour: CameraModel, depth: CameraModel, views: int, seed: int
) -> None:
    """Write `colour/view00.png`, `infrared/view00.png`, …, and the truth: `colour.yaml` and `depth.yaml`.

    Raises:
        ValueError: the folder is not empty, or no pose shows the whole board to both cameras.
        OSError: a file cannot be written.
    """
    _make_empty(folder)
    rng = np.random.default_rng(seed)
    rig = random_rig(colour, depth, rng)
    renderers = {"colour": BoardCamera(board, colour), "infrared": BoardCamera(board, depth)}
    poses = board_pairs(board, rig, rng)
    for name in renderers:
        (folder / name).mkdir()
    for number in range(views):
        for (name, renderer), pose in zip(renderers.items(), next(poses), strict=True):
            _save(folder / name / f"view{number:02d}.png", renderer.render(pose, rng))
    write_camera_info(folder / "colour.yaml", colour, "colour")
    write_camera_info(folder / "depth.yaml", depth, "depth", registration=rig)


def _make_empty(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} exists and is not an empty folder")
    folder.mkdir(parents=True, exist_ok=True)


def _save(path: Path, image: NDArray[np.uint8]) -> None:
    if not cv2.imwrite(str(path), image):
        raise OSError(f"cannot write {path}")


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
def board(
    folder: Annotated[Path, typer.Argument(help="New or empty folder for the images.")],
    board: Annotated[
        tuple[str, str], typer.Option(help="chessboard COLUMNSxROWS (inner corners), or charuco (squares).")
    ] = ("chessboard", "10x7"),
    square: Annotated[float, typer.Option(help="Side of a square, metres.")] = 0.02,
    marker: Annotated[float | None, typer.Option(help="Side of a ChArUco marker, metres.")] = None,
    dictionary: Annotated[
        str | None, typer.Option(help="Dictionary of ChArUco markers, e.g. 4X4_50.")
    ] = None,
    lens: Annotated[
        str, typer.Option(help=f"{', '.join(LENSES)}, or a calibration file (ROS camera_info YAML).")
    ] = "webcam",
    infrared: Annotated[
        str | None, typer.Option(help="Lens of a depth camera's infrared images: pairs of both cameras.")
    ] = None,
    views: Annotated[int, typer.Option(min=1, max=1000, help="Number of images.")] = 40,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the poses and the noise.")] = 0,
) -> None:
    """Write images of a calibration board, for `companion calibrate`, with the true lens."""
    try:
        printed = Board.parse(*board, square, marker, dictionary)
        camera = _lens(lens)
        if infrared is None:
            write_board_views(folder, printed, camera, views, seed)
        else:
            write_board_pairs(folder, printed, camera, _lens(infrared), views, seed)
    except (ValueError, OSError) as error:
        print(f"mavlink-sim board: {error}", file=sys.stderr)
        raise typer.Exit(2) from error
    truth = "truth.yaml" if infrared is None else "depth.yaml"
    print(f"{folder}: {views} views; the true lens is in {folder / truth}", flush=True)


def _lens(name: str) -> CameraModel:
    return LENSES[name] if name in LENSES else read_camera_info(Path(name)).model
