"""Error of a calibration: rendered views of a board, and of a marker for the mount.

    python -m benchmarks.calibration --seeds 1..50 [--mount | --extrinsics] [--processes 2] [--json]

Lens: each seed takes one of the lenses of `mavlink-sim board` (plain, webcam, wide, fisheye) with other
numbers (focal length +-20 %, centre +-2 %, coefficients +-20 %; none that folds the image), and a chessboard
of 10x7 corners or a ChArUco board of 10x7 squares; 40 views of 640x480, noise of 2 grey levels, blur of
0.5 px.

Mount: a marker of 0.5 m lies level before a vehicle on a stand of 1 to 2 m, of known roll and pitch up to 5
degrees; the camera of 640x480 looks 15 to 60 degrees down, up to 10 aside, and is rolled up to 5; 10 images,
noise of 2 grey levels, blur of 0.5 px.

Extrinsics: a depth camera with a lens of its own (that of another seed, the plain one), up to 8 cm beside the
colour camera and turned by up to 3 degrees about each axis. Both lenses are calibrated as above, but from 30
views each; then 20 pairs of views of both. A fisheye has a chessboard.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice

import cv2
import numpy as np

from benchmarks.flights import add_seeds
from companion.simulation.campaign import ClusterError, SeedError, map_seeds
from mavlink_sim.camera.image_effects import ImageEffects
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.datasets.board_views import LENSES, BoardCamera, board_pairs, board_poses, random_rig
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.calibration.boards import Board
from vision.calibration.calibrate import CalibrationResult, calibrate
from vision.calibration.extrinsics import extrinsics_from_views
from vision.calibration.mount import mount_from_markers
from vision.calibration.views import ViewCollector
from vision.camera_model import CameraModel, CameraMount, pixels_without_rays
from vision.markers import Marker, MarkerDetector, MarkerKind
from vision.rotation import matrix_from_euler

VIEWS, MOUNT_IMAGES, MARKER_M = 40, 10, 0.5
RIG_VIEWS, PAIRS, PAIR_TRIES = 30, 20, 60
BOARDS = (Board("chessboard", 10, 7, 0.02), Board("charuco", 10, 7, 0.02, 0.015, "4X4_50"))


@dataclass(frozen=True, slots=True)
class LensError:
    """Error of one calibration: focal length in per cent, centre in pixels, reprojection in pixels RMS.

    `ray_px` is the RMS error of the rays of all pixels that have one, in pixels at the centre.
    """

    seed: int
    lens: str
    board: str
    model: str
    views: int
    focal_percent: float
    centre_px: float
    rms_px: float
    ray_px: float


@dataclass(frozen=True, slots=True)
class MountError:
    """Largest error of the three angles of a mount, degrees, and the number of used images."""

    seed: int
    views: int
    angle_deg: float


@dataclass(frozen=True, slots=True)
class ExtrinsicsError:
    """Error of a depth camera's place on a colour camera."""

    seed: int
    lens: str
    board: str
    views: int
    position_mm: float
    rotation_deg: float
    rms_px: float


Error = LensError | MountError | ExtrinsicsError


def random_lens(seed: int) -> tuple[str, CameraModel]:
    """The lens of a seed, and the name of the one that it varies."""
    rng = np.random.default_rng(seed)
    name = tuple(LENSES)[seed % len(LENSES)]
    lens = LENSES[name]
    while True:
        focal = float(rng.uniform(0.8, 1.2))
        centre = rng.uniform(-0.02, 0.02, 2) * (lens.width, lens.height)
        changed = replace(
            lens,
            fx=lens.fx * focal,
            fy=lens.fy * focal * float(rng.uniform(0.99, 1.01)),
            cx=lens.cx + float(centre[0]),
            cy=lens.cy + float(centre[1]),
            distortion=tuple(float(value) for value in np.array(lens.distortion) * rng.uniform(0.8, 1.2)),
        )
        if not pixels_without_rays(changed):
            return name, changed


def lens_error(seed: int, views: int = VIEWS) -> LensError:
    """Render the views of a seed and calibrate."""
    name, lens = random_lens(seed)
    board = _board(seed)
    result = _calibrated(board, lens, views, np.random.default_rng(seed))
    model = result.model
    focal = max(abs(model.fx / lens.fx - 1.0), abs(model.fy / lens.fy - 1.0))
    centre = max(abs(model.cx - lens.cx), abs(model.cy - lens.cy))
    columns, rows = np.meshgrid(np.arange(0, lens.width, 8), np.arange(0, lens.height, 8))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    off = (model.rays(pixels) - lens.rays(pixels)) * lens.fx
    ray_px = float(np.sqrt(np.nanmean((off**2).sum(axis=1))))
    kind, used = model.distortion_model, len(result.views)
    return LensError(seed, name, board.kind, kind, used, 100 * focal, centre, result.rms_px, ray_px)


def _board(seed: int) -> Board:
    return BOARDS[seed // len(LENSES) % len(BOARDS)]


def _calibrated(board: Board, lens: CameraModel, views: int, rng: np.random.Generator) -> CalibrationResult:
    camera, collector = BoardCamera(board, lens), ViewCollector(board)
    poses = board_poses(board, lens, rng)
    for number in range(views):
        view = board.detect(camera.render(next(poses), rng), f"{number}")
        if view is not None:
            collector.add(view)
    return calibrate(collector.chosen())


def extrinsics_error(seed: int) -> ExtrinsicsError:
    """Calibrate both lenses of a seed's rig, and the depth camera's place."""
    rng = np.random.default_rng(seed)
    (name, colour), (_, depth) = random_lens(seed), random_lens(4 * seed)
    # Where both cameras see the whole board, its markers are too small for a fisheye.
    board = BOARDS[0] if name == "fisheye" else _board(seed)
    models = [_calibrated(board, lens, RIG_VIEWS, rng).model for lens in (colour, depth)]
    rig = random_rig(colour, depth, rng)
    cameras = [BoardCamera(board, lens) for lens in (colour, depth)]
    pairs = []
    for poses in islice(board_pairs(board, rig, rng), PAIR_TRIES):
        one, two = (
            board.detect(camera.render(pose, rng)) for camera, pose in zip(cameras, poses, strict=True)
        )
        if one is not None and two is not None:
            pairs.append((one, two))
        if len(pairs) == PAIRS:
            break
    result = extrinsics_from_views(pairs, *models)
    found = result.calibration
    position_mm = float(np.linalg.norm(found.position_m - rig.position_m)) * 1000
    turn = np.degrees(np.linalg.norm(cv2.Rodrigues(found.rotation @ rig.rotation.T)[0]))
    return ExtrinsicsError(seed, name, board.kind, result.views, position_mm, float(turn), result.rms_px)


def mount_error(seed: int) -> MountError:
    """Render the marker of a seed and measure the camera's angles."""
    rng = np.random.default_rng(seed)
    _, lens = random_lens(4 * seed + 1)
    angles = np.radians([rng.uniform(-5, 5), rng.uniform(-60, -15), rng.uniform(-10, 10)])
    mount = CameraMount(0.1, 0.0, 0.05, *angles.tolist())
    roll, pitch, nose, heading = np.radians(rng.uniform((-5, -5, -180, -20), (5, 5, 180, 20))).tolist()
    height_m = float(rng.uniform(1.0, 2.0))
    attitude = matrix_from_euler(roll, pitch, nose)
    ahead = attitude @ mount.body_from_optical[:, 2]
    reach = min(height_m / max(float(ahead[2]), 0.25), 3.5)
    found: list[Marker] = []
    detector = MarkerDetector(MarkerKind("4X4_50", MARKER_M))
    effects = ImageEffects(blur_sigma_px=0.5, noise_sigma=2.0)
    printed = Print("4X4_50", 7, MARKER_M)
    world = World((), Ground(("concrete",), seed, 256, 0.05))
    renderer = Renderer(world, lens, mount, effects, rng=rng)
    for _ in range(MOUNT_IMAGES):
        north, east = ahead[:2] * reach + rng.normal(0.0, 0.1, 2)
        place = (float(north), float(east), 0.0)
        renderer.place([WorldObject(0, "plate", place, nose + heading, printed=printed)])
        image = renderer.render((0.0, 0.0, -height_m), attitude).image
        found += detector.detect(image, lens)
    result = mount_from_markers(found, heading, roll, pitch)
    measured = np.array([result.roll_rad, result.pitch_rad, result.yaw_rad])
    return MountError(seed, result.views, float(np.degrees(np.abs(measured - angles).max())))


def _in_one_thread(measure: Callable[[int], Error], seed: int) -> Error:
    cv2.setNumThreads(1)
    return measure(seed)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns the exit code: 2 for a cluster that does not exist, or a seed that fails."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.calibration", description=(__doc__ or "").partition("\n")[0]
    )
    add_seeds(parser, "1..50")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--mount", action="store_true", help="the mount instead of the lens")
    what.add_argument("--extrinsics", action="store_true", help="a depth camera's place on the colour camera")
    parser.add_argument("--json", action="store_true", help="one JSON object per seed")
    given = parser.parse_args(arguments)
    measure: Callable[[int], Error] = lens_error
    if given.mount or given.extrinsics:
        measure = mount_error if given.mount else extrinsics_error
    results = []
    try:
        measured = partial(_in_one_thread, measure)
        for result in map_seeds(measured, given.seeds, processes=given.processes, ray=given.ray):
            results.append(result)
            row = asdict(result)
            values = (f"{value:.3f}" if isinstance(value, float) else str(value) for value in row.values())
            print(json.dumps(row) if given.json else "  ".join(values), flush=True)
    except (ClusterError, SeedError) as error:
        print(error, file=sys.stderr)
        return 2
    for key in (
        *("focal_percent", "centre_px", "rms_px", "ray_px", "angle_deg"),
        *("position_mm", "rotation_deg"),
    ):
        if hasattr(results[0], key) and not given.json:
            numbers = np.array([getattr(result, key) for result in results])
            median, p95, worst = np.quantile(numbers, (0.5, 0.95, 1.0))
            print(f"{key}: median {median:.3f}, p95 {p95:.3f}, worst {worst:.3f} of {len(numbers)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
