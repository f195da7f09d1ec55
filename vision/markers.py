"""ArUco and AprilTag markers: detection in an image, and pose relative to the camera.

Markers after Garrido-Jurado et al. 2014 and Olson 2011, detected by OpenCV. A square marker's pose follows
from its four corners in closed form (IPPE: Collins and Bartoli, Infinitesimal Plane-based Pose Estimation,
2014), which gives two solutions. Seen from far away or nearly face on, both fit about equally well: they
hardly differ in position, but in orientation. Both are kept, so that a caller with more knowledge (that a pad
is level) can choose; `vision.marker_ambiguity` resolves them over several frames.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera_model import MIN_COSINE, CameraModel
from vision.marker_dictionaries import dictionary_named, opencv_dictionary
from vision.marker_edges import CORNER_SIGMA_PX, corners_on_edges

# A false detection, or corners displaced by blur, fits no pose: largest RMS over the corners, as a share of
# the marker's side in the image, and never less than this many pixels.
WORST_FIT, WORST_FIT_PX = 0.05, 2.0
# Two poses rotated less than this apart are the same; the most iterations of a fit.
SAME_RAD, _MAX_STEPS = 0.005, 8
# Whose print a marker is: its upper edge differs. The images that AprilRobotics publishes are those of
# OpenCV's dictionaries turned by 180 degrees: all four families, compared with the codes of its library.
PRINTS = ("opencv", "apriltag")


@dataclass(frozen=True, slots=True)
class MarkerKind:
    """Dictionary and sizes of the markers to detect.

    Attributes:
        dictionary: one of DICTIONARIES, "4X4_50", "APRILTAG_36h11"; given by any name of `dictionary_named`.
        size_m: side of the black square, metres.
        sizes_m: size per id, for ids with another size.
        print: one of PRINTS: whose print the markers are. prints: the same per id, for others.

    Raises:
        ValueError: no such dictionary, an id that is not in it, a size that is not positive, or a print that
            the dictionary does not have.
    """

    dictionary: str
    size_m: float
    sizes_m: Mapping[int, float] = field(default_factory=dict)
    print: str = PRINTS[0]
    prints: Mapping[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "dictionary", dictionary_named(self.dictionary))
        count = markers_in(self.dictionary)
        for identifier in (*self.sizes_m, *self.prints):
            if not 0 <= identifier < count:
                raise ValueError(
                    f"marker id {identifier} is not in dictionary {self.dictionary} (0 to {count - 1})"
                )
        for size_m in (self.size_m, *self.sizes_m.values()):
            if not (math.isfinite(size_m) and size_m > 0.0):
                raise ValueError(f"a marker's side must be finite and above 0 m, got {size_m}")
        for origin in (self.print, *self.prints.values()):
            if origin not in PRINTS:
                raise ValueError(f"the print must be one of {', '.join(PRINTS)}, got {origin!r}")
            if origin == "apriltag" and not is_apriltag(self.dictionary):
                raise ValueError(
                    f"the print 'apriltag' is for AprilTag's dictionaries, got {self.dictionary}: "
                    "use 'opencv'"
                )

    def size_of(self, identifier: int) -> float:
        """Side of that marker's black square, metres."""
        return self.sizes_m.get(identifier, self.size_m)

    def turned(self, identifier: int) -> bool:
        """Whether that marker's print is OpenCV's turned by 180 degrees."""
        return self.prints.get(identifier, self.print) == "apriltag"


@dataclass(frozen=True, slots=True)
class PadMarker:
    """One marker of a pad with several: with several sizes, one is visible from every height.

    Attributes:
        identifier: of this marker. pad: id of the marker whose centre is the pad's.
        right_m, up_m: this marker's centre from the pad's, along the print's right and upper edge; both are
            printed the same way up.
    """

    identifier: int
    pad: int
    right_m: float = 0.0
    up_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPose:
    """Pose of a marker relative to the camera.

    Attributes:
        position_camera_m: (3,) its centre in the optical frame: right, down, forward.
        rotation: (3, 3) `optical_from_marker`; x to the marker's right, y to its upper edge, z out of it.
        reprojection_px: RMS reprojection error of its four corners, pixels.
        covariance: (6, 6) of the position, m², and of a small rotation about the camera's axes, rad², for
            corners with a noise of `CORNER_SIGMA_PX`, or more where they fit worse. To first order: seen face
            on from far away, the tilt's is a lower bound.
    """

    position_camera_m: NDArray[np.float64]
    rotation: NDArray[np.float64]
    reprojection_px: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """One marker in one image. Small and picklable.

    Attributes:
        identifier: in its dictionary.
        size_m: assumed side of the black square, metres.
        corners_px: (4, 2) float64 pixels: its upper left corner, then clockwise as printed.
        position_camera_m, rotation, reprojection_px, covariance: of the better fitting pose; see MarkerPose.
        other: the second pose that fits the same corners; None if there is none.
        corner_sigma_px: noise of a corner along each image axis, one sigma.
    """

    identifier: int
    size_m: float
    corners_px: NDArray[np.float64]
    position_camera_m: NDArray[np.float64]
    rotation: NDArray[np.float64]
    reprojection_px: float
    covariance: NDArray[np.float64]
    other: MarkerPose | None = None
    corner_sigma_px: float = CORNER_SIGMA_PX

    @property
    def poses(self) -> tuple[MarkerPose, ...]:
        """The one or two poses that fit, the better one first."""
        own = MarkerPose(self.position_camera_m, self.rotation, self.reprojection_px, self.covariance)
        return (own,) if self.other is None else (own, self.other)

    @property
    def ambiguity(self) -> float:
        """Error of the first pose over that of the second: 0 unambiguous, 1 both fit equally well."""
        if self.other is None or self.other.reprojection_px <= 0.0:
            return 0.0
        return self.reprojection_px / self.other.reprojection_px

    @property
    def side_px(self) -> float:
        """Mean length of its sides in the image, pixels."""
        corners = self.corners_px.tolist()
        return sum(map(math.dist, corners, corners[1:] + corners[:1])) / 4.0


def markers_in(dictionary: str) -> int:
    """Number of markers in a dictionary. Raises ValueError, listing the known dictionaries."""
    return len(opencv_dictionary(dictionary).bytesList)


def is_apriltag(dictionary: str) -> bool:
    """Whether a dictionary is one of AprilTag's families. Raises ValueError: no such dictionary."""
    return dictionary_named(dictionary).startswith("APRILTAG_")


def marker_modules(kind: MarkerKind, identifier: int) -> NDArray[np.bool_]:
    """(N, N) the modules of a print as seen upright, its black border included; True is black.

    Raises:
        ValueError: the id is not in the dictionary.
    """
    count = markers_in(kind.dictionary)
    if not 0 <= identifier < count:
        raise ValueError(f"marker id {identifier} is not in dictionary {kind.dictionary} (0 to {count - 1})")
    dictionary = opencv_dictionary(kind.dictionary)
    image = cv2.aruco.generateImageMarker(dictionary, identifier, dictionary.markerSize + 2)
    black = np.asarray(image) < 128
    return np.rot90(black, 2) if kind.turned(identifier) else black


class MarkerDetector:
    """Detects the markers of one dictionary in images."""

    def __init__(self, kind: MarkerKind) -> None:
        self.kind = kind
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = opencv_dictionary(kind.dictionary)
        # With the border of one module.
        self._modules = dictionary.markerSize + 2
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def detect(self, image_bgr: NDArray[np.uint8], camera: CameraModel) -> tuple[Marker, ...]:
        """Detect markers, sorted by id.

        Args:
            image_bgr: (height, width, 3) uint8 BGR, or (height, width) uint8 grey.
            camera: the model for images of this size.

        Raises:
            ValueError: the image's size differs from the camera model's.
        """
        if image_bgr.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"the camera model is for {camera.width}x{camera.height} pixels, the image has "
                f"{image_bgr.shape[1]}x{image_bgr.shape[0]}"
            )
        grey = image_bgr if image_bgr.ndim == 2 else cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
        corners, identifiers, _ = self._detector.detectMarkers(grey)
        if identifiers is None:
            return ()
        found = [
            self._marker(grey, int(identifier), points, camera)
            for identifier, points in zip(np.ravel(identifiers), corners, strict=True)
        ]
        return tuple(sorted((marker for marker in found if marker), key=lambda marker: marker.identifier))

    def _marker(
        self, grey: NDArray[Any], identifier: int, corners_px: NDArray[Any], camera: CameraModel
    ) -> Marker | None:
        refined_px, sigma_px = corners_on_edges(grey, corners_px, self._modules, camera)
        if self.kind.turned(identifier):
            refined_px = np.roll(refined_px, 2, axis=0)
        return marker_from_corners(identifier, refined_px, self.kind.size_of(identifier), camera, sigma_px)


def marker_from_corners(
    identifier: int,
    corners_px: NDArray[Any],
    size_m: float,
    camera: CameraModel,
    corner_sigma_px: float = CORNER_SIGMA_PX,
) -> Marker | None:
    """The marker with these corners; None where no pose in front of the camera fits.

    Args:
        corners_px: (4, 2) pixels: its upper left corner, then clockwise as printed.
        size_m: side of the black square, metres.
        corner_sigma_px: noise of a corner along each image axis, one sigma.
    """
    corners = np.asarray(corners_px, np.float64).reshape(4, 2)
    poses = marker_poses(corners, size_m, camera, corner_sigma_px)
    if not poses:
        return None
    best = poses[0]
    marker = Marker(
        identifier,
        size_m,
        corners,
        best.position_camera_m,
        best.rotation,
        best.reprojection_px,
        best.covariance,
        poses[1] if len(poses) > 1 else None,
        corner_sigma_px,
    )
    return marker if best.reprojection_px <= max(WORST_FIT_PX, WORST_FIT * marker.side_px) else None


def marker_poses(
    corners_px: NDArray[np.float64],
    size_m: float,
    camera: CameraModel,
    corner_sigma_px: float = CORNER_SIGMA_PX,
) -> list[MarkerPose]:
    """The poses that fit the corners, the better one first: two, one or none.

    Poses behind the camera, or showing the marker's back, are dropped.

    Args:
        corners_px, corner_sigma_px: as of `marker_from_corners`.
    """
    if not np.isfinite(corners_px).all():
        return []
    if not (camera.rays(corners_px)[:, 2] > MIN_COSINE).all():
        return []
    plane = _plane(camera, corners_px)
    model = square(size_m)
    starts = [(rotation, _position(model @ rotation.T, plane)) for rotation in _rotations(model, plane)]
    poses = fit_poses(model, corners_px, camera, starts, corner_sigma_px)
    return [pose for pose in poses if pose.rotation[:, 2] @ pose.position_camera_m < 0.0]


def fit_poses(
    model: NDArray[np.float64],
    pixels: NDArray[np.float64],
    camera: CameraModel,
    starts: Iterable[tuple[NDArray[np.float64], NDArray[np.float64]]],
    sigma_px: float = CORNER_SIGMA_PX,
) -> list[MarkerPose]:
    """Poses of a rigid set of points that fit its pixels, refined from starts; the best first, none twice.

    Args:
        model: (N, 3) points in their own frame, at least four. pixels: (N, 2) their projections.
        starts: (3, 3) rotations `optical_from_model` and (3,) positions in the optical frame.
        sigma_px: noise of a pixel along each axis; for the covariance the residuals' if that is larger.
    """
    plane = _plane(camera, pixels)
    poses: list[MarkerPose] = []
    for start in starts:
        rotation, position = _refined(model, plane, *start)
        ahead = model @ rotation.T + position
        if not (np.isfinite(ahead).all() and ahead[:, 2].min() > 0.0):
            continue
        error_px = float(np.sqrt(((camera.project(ahead) - pixels) ** 2).sum(axis=1).mean()))
        jacobian = _jacobian(ahead - position, ahead)
        with contextlib.suppress(np.linalg.LinAlgError):
            sigma = 2.0 * max(sigma_px, error_px / math.sqrt(2.0)) / (camera.fx + camera.fy)
            covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian) * sigma**2, np.float64)
            if math.isfinite(error_px):
                poses.append(MarkerPose(position, rotation, error_px, covariance))
    poses.sort(key=lambda pose: pose.reprojection_px)
    return [pose for i, pose in enumerate(poses) if not any(_same(pose, other) for other in poses[:i])]


def _rotations(model: NDArray[np.float64], plane: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """IPPE: the two rotations that agree with the homography at the marker's centre; empty if degenerate.

    OpenCV's solver is not used: its rotation vectors fail at half a turn, which is a marker seen face on
    (found with OpenCV 5.0).

    Args:
        model: (4, 3) corners in the marker's plane. plane: (4, 2) their projections at unit depth.
    """
    if len(set(map(tuple, plane.tolist()))) < 4:
        return ()
    homography = _homography(model[:, :2], plane)
    if not np.isfinite(homography).all():
        return ()
    centre = homography[:2, 2]
    jacobian = homography[:2, :2] - np.outer(centre, homography[2, :2])
    ahead = _turn_to(centre)
    outward = np.array([[1.0, 0.0, -centre[0]], [0.0, 1.0, -centre[1]]]) @ ahead
    scaled = np.linalg.solve(outward[:, :2], jacobian)
    largest = float(np.linalg.svd(scaled, compute_uv=False)[0])
    if largest < 1e-12:
        return ()
    upper = scaled / largest
    gram = np.eye(2) - upper.T @ upper
    lower = np.sqrt(np.maximum(np.diag(gram), 0.0)) * (1.0, -1.0 if gram[0, 1] < 0.0 else 1.0)
    rotations = []
    for sign in (1.0, -1.0):
        first, second = np.vstack([upper, sign * lower]).T
        rotated = np.column_stack([first, second, np.cross(first, second)])
        left, _, right = np.linalg.svd(ahead @ rotated)
        rotations.append(np.asarray(left @ right, np.float64))
    return tuple(rotations)


def _homography(model: NDArray[np.float64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) from the marker's plane to the four projections; its last element is 1. NaN if degenerate."""
    rows = []
    for (x, y), (u, v) in zip(model, plane, strict=True):
        rows.append([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y])
        rows.append([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y])
    try:
        solution = np.linalg.solve(np.array(rows), plane.ravel())
    except np.linalg.LinAlgError:
        return np.full((3, 3), np.nan)
    homography: NDArray[np.float64] = np.append(solution, 1.0).reshape(3, 3)
    return homography


def _turn_to(point: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) shortest rotation of the optical axis to the ray through (x, y, 1), after Rodrigues."""
    ray = np.array([point[0], point[1], 1.0])
    ray /= np.linalg.norm(ray)
    x, y, cosine = ray
    cross = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    turn: NDArray[np.float64] = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    return turn


def _position(rotated: NDArray[np.float64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) the marker's centre, by least squares over the rotated corners (4, 3)."""
    count = len(plane)
    system, wanted = np.zeros((2 * count, 3)), np.zeros(2 * count)
    system[0::2, 0] = system[1::2, 1] = 1.0
    system[0::2, 2], system[1::2, 2] = -plane[:, 0], -plane[:, 1]
    wanted[0::2] = plane[:, 0] * rotated[:, 2] - rotated[:, 0]
    wanted[1::2] = plane[:, 1] * rotated[:, 2] - rotated[:, 1]
    return np.asarray(np.linalg.lstsq(system, wanted, rcond=None)[0], np.float64)


def _refined(
    model: NDArray[np.float64],
    plane: NDArray[np.float64],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Refine a pose to fit all corners: Levenberg's damped least squares.

    The homography's slope at one point turns half a pixel of error into degrees of tilt, seen face on.
    """
    damping, fit = 1e-3, _residuals(model, plane, rotation, position)
    for _ in range(_MAX_STEPS):
        rotated = model @ rotation.T
        ahead = rotated + position
        if not np.isfinite(fit).all() or ahead[:, 2].min() <= 0.0:
            break
        jacobian = _jacobian(rotated, ahead)
        normal = jacobian.T @ jacobian
        normal.flat[::7] *= 1.0 + damping
        try:
            step = np.linalg.solve(normal, -(jacobian.T @ fit))
        except np.linalg.LinAlgError:
            break
        new_rotation = cv2.Rodrigues(step[3:])[0] @ rotation
        new_position = position + step[:3]
        new_fit = _residuals(model, plane, new_rotation, new_position)
        gained = fit @ fit - new_fit @ new_fit
        if not gained > 0.0:
            damping *= 10.0
            continue
        rotation, position, fit, damping = new_rotation, new_position, new_fit, damping / 10.0
        if gained < 1e-10:  # a hundredth of a pixel
            break
    return rotation, position


def _jacobian(rotated: NDArray[np.float64], ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2N, 6) derivative of the projections at unit depth by the position and by a small rotation.

    Args:
        rotated: (N, 3) points in the optical frame's directions, from the model's origin; the rotation is
            about the camera's axes through that. ahead: (N, 3) the same from the camera.
    """
    jacobian = np.zeros((2 * len(ahead), 6))
    across, along = jacobian[0::2], jacobian[1::2]
    (x, y, z), nearness = rotated.T, 1.0 / ahead[:, 2]
    u, v = ahead[:, 0] * nearness, ahead[:, 1] * nearness
    across[:, 0] = along[:, 1] = nearness
    across[:, 2], along[:, 2] = -u * nearness, -v * nearness
    across[:, 3], across[:, 4], across[:, 5] = -u * y * nearness, (z + u * x) * nearness, -y * nearness
    along[:, 3], along[:, 4], along[:, 5] = -(z + v * y) * nearness, v * x * nearness, x * nearness
    return jacobian


def _residuals(
    model: NDArray[np.float64],
    plane: NDArray[np.float64],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(2N,) reprojection errors of the points, at unit depth."""
    ahead = model @ rotation.T + position
    error: NDArray[np.float64] = (ahead[:, :2] / ahead[:, 2:] - plane).ravel()
    return error


def _plane(camera: CameraModel, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) pixels → (N, 2) x and y of their rays at unit depth."""
    rays = camera.rays(pixels)
    return rays[:, :2] / rays[:, 2:]


def _same(one: MarkerPose, other: MarkerPose) -> bool:
    """Whether two rotations are equal: both fits converged to one solution."""
    return bool(np.trace(one.rotation.T @ other.rotation) > 1.0 + 2.0 * math.cos(SAME_RAD))


def square(size_m: float) -> NDArray[np.float64]:
    """(4, 3) corners of a marker of side `size_m` in its frame, metres: upper left, then clockwise."""
    half = size_m / 2
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
