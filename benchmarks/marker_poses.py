"""How true the poses of markers in rendered images are, and how honest their covariances.

    python -m benchmarks.marker_poses --seeds 1..10
    python -m benchmarks.marker_poses --seeds 1..10 --blur-px 2 --noise 8
    python -m benchmarks.marker_poses --seeds 1..10 --samples 4

Each seed is a scene with one AprilTag of 0.5 m, lying or standing on the ground in the sun, 20 times from 1.2
to 5.5 m and up to 69° from its face (640x480, 70° across). Markers of at least 40 px a side count. Of two
poses that fit, the attitude is that of the nearer one.

The renderer draws an edge of a surface by the middle of each pixel, so one that lies along a row of pixels
can be half a pixel off. A camera averages the light over a pixel, and so does `--samples`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.structures import PLATE_THICKNESS_M
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.marker_boards import ned_from_marker
from vision.marker_edges import CORNER_SIGMA_PX
from vision.markers import MarkerDetector, MarkerKind, square
from vision.rotation import matrix_from_euler

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(70.0))
GROUND = Ground(("concrete",), 0, 256, 0.05)
KIND = MarkerKind("APRILTAG_36h11", 0.5)
IDENTIFIER, LEAST_SIDE_PX, IMAGES = 7, 40.0, 20
RANGES_M, MOST_TILT_RAD = (1.2, 5.5), 1.2

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PoseError:
    """Errors of one marker.

    Attributes:
        range_share: error of the position, as a share of the range. angle_deg: of the attitude.
        corner_px: RMS error of the corners along each axis of the image.
        normalized: (6,) errors of position and rotation over their stated one-sigma errors.
        corner_sigma_px: of the marker.
    """

    range_share: float
    angle_deg: float
    corner_px: float
    normalized: Matrix
    corner_sigma_px: float


def pose_errors(
    seed: int, count: int = IMAGES, blur_px: float = 0.0, noise: float = 0.0, samples: int = 1
) -> Iterator[PoseError | None]:
    """Of `count` images of one scene; None: no marker is found. The same seed gives the same.

    Args:
        blur_px, noise: one sigma of a Gaussian blur, and then of noise of each colour (of 255).
        samples: the number along each side of a pixel whose mean is the pixel.
    """
    rng, noise_rng = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    standing = bool(seed % 2)
    printed = Print(KIND.dictionary, IDENTIFIER, KIND.size_m, standing)
    yaw = rng.uniform(-math.pi, math.pi)
    plate = WorldObject(0, "plate", (0, 0, 0), yaw, printed=printed)
    camera = CAMERA.scaled(samples * CAMERA.width, samples * CAMERA.height)
    renderer = Renderer(World((plate,), GROUND), camera, CameraMount())
    ned = ned_from_marker(yaw, standing)
    up_m = printed.board_side_m / 2 if standing else PLATE_THICKNESS_M
    centre = np.array([0.0, 0.0, -up_m]) + (ned[:, 2] * PLATE_THICKNESS_M / 2 if standing else 0.0)
    detector = MarkerDetector(KIND)
    while count > 0:
        range_m, tilt, around = (
            rng.uniform(*RANGES_M),
            rng.uniform(0.0, MOST_TILT_RAD),
            rng.uniform(-math.pi, math.pi),
        )
        out = [math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)]
        eye = centre + range_m * (ned @ out)
        if eye[2] > -0.3:
            continue
        count -= 1
        attitude = _looking_at(eye - centre, rng)
        optical_from_ned = CameraMount().ned_from_optical(attitude).T
        position, rotation = optical_from_ned @ (centre - eye), optical_from_ned @ ned
        image = renderer.render(tuple(eye), attitude).image
        if samples > 1:
            size = (CAMERA.width, CAMERA.height)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        if blur_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px), np.uint8)
        if noise > 0.0:
            noisy = image + noise_rng.normal(0.0, noise, image.shape)
            image = np.clip(np.rint(noisy), 0.0, 255.0).astype(np.uint8)
        found = detector.detect(image, CAMERA)
        if not found:
            yield None
            continue
        (marker,) = found
        if marker.side_px < LEAST_SIDE_PX:
            continue
        poses = [(angle_deg(pose.rotation, rotation), pose) for pose in marker.poses]
        angle, pose = min(poses, key=lambda each: each[0])
        true_px = CAMERA.project(square(KIND.size_m) @ rotation.T + position)
        turn = cv2.Rodrigues(pose.rotation @ rotation.T)[0].ravel()
        errors = np.concatenate([pose.position_camera_m - position, turn])
        yield PoseError(
            float(np.linalg.norm(marker.position_camera_m - position)) / range_m,
            angle,
            float(np.sqrt(np.square(marker.corners_px - true_px).mean())),
            errors / np.sqrt(np.diag(pose.covariance)),
            marker.corner_sigma_px,
        )


def angle_deg(one: Matrix, other: Matrix) -> float:
    """Angle between two (3, 3) rotations."""
    return math.degrees(math.acos(max(-1.0, min(1.0, (np.trace(one.T @ other) - 1.0) / 2.0))))


def _looking_at(eye: Matrix, rng: np.random.Generator) -> Matrix:
    """`ned_from_body` of a camera that has the origin in the image, rolled and off the centre."""
    yaw, pitch = math.atan2(-eye[1], -eye[0]), -math.atan2(-eye[2], math.hypot(eye[0], eye[1]))
    off = rng.uniform(-0.1, 0.1, 2)
    heading = matrix_from_euler(0.0, 0.0, yaw + off[0])
    return heading @ matrix_from_euler(rng.uniform(-0.4, 0.4), pitch + off[1], 0.0)


def main() -> None:
    """Print the errors of all images."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--seeds", default="1..10", help="FIRST..LAST")
    parser.add_argument("--blur-px", type=float, default=0.0, help="Gaussian blur of the images, one sigma")
    parser.add_argument("--noise", type=float, default=0.0, help="noise of each colour, one sigma of 255")
    parser.add_argument("--samples", type=int, default=1, help="samples along each side of a pixel")
    given = parser.parse_args()
    if given.samples < 1:
        parser.error("--samples must be at least 1")
    first, _, last = given.seeds.partition("..")
    taken = [
        error
        for seed in range(int(first), int(last or first) + 1)
        for error in pose_errors(seed, blur_px=given.blur_px, noise=given.noise, samples=given.samples)
    ]
    errors = [error for error in taken if error is not None]
    print(f"{len(errors)} markers; {len(taken) - len(errors)} images without one")
    corner_px = math.sqrt(float(np.mean([error.corner_px**2 for error in errors])))
    for name, values in (
        ("position, % of the range", [100.0 * error.range_share for error in errors]),
        ("attitude, degrees", [error.angle_deg for error in errors]),
        (f"corner, px RMS (all: {corner_px:.3f})", [error.corner_px for error in errors]),
    ):
        p50, p95 = np.percentile(values, [50, 95])
        print(f"{name}: p50 {p50:.3f}, p95 {p95:.3f}, worst {max(values):.3f}")
    print(f"attitudes within 2 degrees: {sum(error.angle_deg <= 2.0 for error in errors)}")
    rough = [error.corner_px for error in errors if error.corner_sigma_px > CORNER_SIGMA_PX]
    print(
        f"corners with a larger noise: {len(rough)}; {np.sqrt(np.mean(np.square(rough or [0.0]))):.3f} px RMS"
    )
    normalized = np.abs([error.normalized for error in errors])
    inside, scaled = (float((normalized < bound).mean()) for bound in (1.0, corner_px / CORNER_SIGMA_PX))
    print(f"within one stated sigma: {inside:.1%}; worst {normalized.max():.1f} sigma")
    print(f"within one sigma, scaled to the noise of these corners: {scaled:.1%}")


if __name__ == "__main__":
    main()
