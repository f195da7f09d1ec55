"""The camera with lens distortion, and how it is mounted on the vehicle.

Optical frame: x right, y down, z forward. Pixel (0, 0) is the centre of the top-left pixel.
The distortion models have ROS's names (`sensor_msgs/CameraInfo`) and OpenCV's coefficients:

| name | coefficients | |
|---|---|---|
| `plumb_bob` | k1, k2, p1, p2, k3 (none, four or five) | Brown-Conrady |
| `rational_polynomial` | k1, k2, p1, p2, k3, k4, k5, k6 | the same with a divisor |
| `equidistant` | k1, k2, k3, k4 | fisheye: Kannala and Brandt 2006 |
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.rotation import BODY_FROM_OPTICAL, matrix_from_euler

PLUMB_BOB, RATIONAL, EQUIDISTANT = "plumb_bob", "rational_polynomial", "equidistant"
DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
DISTORTION_MODELS: tuple[DistortionModel, ...] = get_args(DistortionModel)
_COEFFICIENTS = {PLUMB_BOB: (0, 4, 5), RATIONAL: (8,), EQUIDISTANT: (4,)}
# Rays nearer than this to the plane across the optical axis have no usable point at unit depth.
MIN_COSINE = 0.02
_MAX_STEPS = 20
_SAME_ASPECT = 0.01
# Largest error of an inverted distortion, at unit depth.
_INVERTED = 1e-9


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Intrinsics of one camera. Focal lengths and principal point in pixels.

    Raises ValueError for a size or focal length that is not positive, a number that is not finite, or
    coefficients that do not belong to the distortion model.

    >>> import math
    >>> from vision import CameraModel
    >>> camera = CameraModel.from_horizontal_fov(640, 480, math.radians(90.0))
    >>> camera.project([[1.0, 0.0, 2.0]]).round(1).tolist()  # 1 m right, 2 m ahead
    [[479.5, 239.5]]
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    distortion_model: DistortionModel = "plumb_bob"

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0 or self.fx <= 0 or self.fy <= 0:
            raise ValueError(
                f"a camera needs a positive size and focal length, got {self.width}x{self.height}, "
                f"fx {self.fx}, fy {self.fy}"
            )
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy, *self.distortion))):
            raise ValueError(
                f"a camera's numbers must be finite, got fx {self.fx}, fy {self.fy}, cx {self.cx}, "
                f"cy {self.cy}, distortion {self.distortion}"
            )
        check_distortion(self.distortion_model, self.distortion)
        object.__setattr__(self, "distortion", tuple(self.distortion))  # a list has no hash

    @classmethod
    def from_horizontal_fov(cls, width: int, height: int, fov_rad: float) -> CameraModel:
        """Square pixels, centred, no distortion, with a horizontal field of view `fov_rad`."""
        if not 0.0 < fov_rad < math.pi:
            raise ValueError(f"horizontal field of view must be in 0..π rad, got {fov_rad}")
        focal = width / 2 / math.tan(fov_rad / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) camera matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> tuple[float, ...]:
        """All coefficients of the distortion model, as in ROS's CameraInfo: five, eight or four."""
        return (*self.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[: max(_COEFFICIENTS[self.distortion_model])]

    @property
    def rectilinear(self) -> bool:
        """Whether straight lines are straight in the image: an ideal pinhole camera."""
        return self.distortion_model != EQUIDISTANT and not any(self.distortion)

    @property
    def horizontal_fov_rad(self) -> float:
        """Horizontal field of view; that of a pinhole camera is without its distortion."""
        if self.distortion_model != EQUIDISTANT:
            return 2 * math.atan(self.width / 2 / self.fx)
        left, right = self.rays(np.array([[-0.5, self.cy], [self.width - 0.5, self.cy]]))
        edges = (math.atan2(-left[0], left[2]), math.atan2(right[0], right[2]))
        return sum(_max_theta(self.distortion) if math.isnan(edge) else edge for edge in edges)

    def scaled(self, width: int, height: int) -> CameraModel:
        """The same camera at another image size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def project(self, points_optical: NDArray[Any]) -> NDArray[np.float64]:
        """(N, 3) points in the optical frame → (N, 2) pixels; NaN for points that the lens cannot see.

        A pinhole camera sees what is in front of it, a fisheye also what is behind; both within the angle
        from the axis up to which their distortion ascends: from there on it would fold the image back.
        """
        points = np.asarray(points_optical, np.float64).reshape(-1, 3)
        if self.distortion_model == EQUIDISTANT:
            pixels = np.full((len(points), 2), np.nan)
            across = np.sqrt((points[:, :2] ** 2).sum(axis=1))
            theta = np.arctan2(across, points[:, 2])
            seen = (theta <= _max_theta(self.distortion)) & (points.any(axis=1))
            # On the axis, where the direction is undefined, the image is its centre.
            scale = _equidistant(self.distortion, theta)[0] / np.where(across > 0.0, across, 1.0)
            pixels[seen] = (points[:, :2] * scale[:, None] * (self.fx, self.fy) + (self.cx, self.cy))[seen]
            return pixels
        plane = points[:, :2] / np.where(points[:, 2:] > 1e-9, points[:, 2:], np.nan)
        if self.distortion:
            largest = _max_radius(self.distortion) * (1.0 + _INVERTED)
            beyond = plane[:, 0] ** 2 + plane[:, 1] ** 2 > largest**2
            plane = _distorted(self.distortion, plane)
            plane[beyond] = np.nan
        return plane * (self.fx, self.fy) + (self.cx, self.cy)

    def rays(self, pixels: NDArray[Any]) -> NDArray[np.float64]:
        """(N, 2) pixels → (N, 3) unit vectors in the optical frame; NaN where no ray reaches the pixel.

        A fisheye of more than 180 degrees also has rays with z below zero.
        """
        points = np.asarray(pixels, np.float64).reshape(-1, 2)
        plane = (points - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.distortion_model == EQUIDISTANT:
            return _equidistant_rays(self.distortion, plane)
        if self.distortion and len(points):
            start = cv2.undistortPoints(points.reshape(-1, 1, 2), self.matrix, np.array(self.distortion))
            plane = _undistorted(self.distortion, plane, np.asarray(start, np.float64).reshape(-1, 2))
        rays = np.ones((len(plane), 3))
        rays[:, :2] = plane
        rays /= np.sqrt((rays * rays).sum(axis=1, keepdims=True))
        return rays


def scaled_to_frames(model: CameraModel, width: int, height: int) -> CameraModel:
    """A calibrated lens for frames of another size. Raises ValueError, naming both, for another aspect."""
    if abs(width * model.height / (height * model.width) - 1.0) > _SAME_ASPECT:
        raise ValueError(
            f"the lens was calibrated with images of {model.width}x{model.height}, the frames have "
            f"{width}x{height}, another aspect: calibrate with such frames, or set the width and height"
        )
    return model.scaled(width, height)


def pixels_without_rays(model: CameraModel) -> str:
    """Where a lens gives pixels of its image no rays, as a sentence with what to do; empty: nowhere.

    Beyond 90 degrees from the axis of a fisheye nothing is missing: its image is a circle.
    """
    x, y = (np.linspace(0, side - 1, 9) for side in (model.width, model.height))
    edge = np.array([(a, b) for a in x for b in (y[0], y[-1])] + [(a, b) for a in (x[0], x[-1]) for b in y])
    fisheye = model.distortion_model == EQUIDISTANT
    largest = _max_theta(model.distortion) if fisheye else _max_radius(model.coefficients)
    if np.isfinite(model.rays(edge)).all() or (fisheye and largest >= math.pi / 2):
        return ""
    farthest_px = np.sqrt(((edge - (model.cx, model.cy)) ** 2).sum(axis=1)).max()
    angle_rad = largest if fisheye else math.atan(largest)
    inside_rad = 0.999 * angle_rad
    rim_px = model.project(np.array([[math.sin(inside_rad), 0.0, math.cos(inside_rad)]]))[0, 0] - model.cx
    place = f" {rim_px:.0f} px from its centre ({math.degrees(angle_rad):.0f} degrees from the axis)"
    if not math.isfinite(rim_px):  # a tangential distortion that folds it before
        place = ""
    return (
        f"the distortion ({model.distortion_model}) folds the image{place}, and its corners are up to "
        f"{farthest_px:.0f} px away: pixels beyond have no direction, and objects there no position; "
        f"calibrate with views of the board there"
    )


def check_distortion(model: str, coefficients: tuple[float, ...]) -> None:
    """Raise ValueError for an unknown distortion model or a number of coefficients that it does not have."""
    if model not in _COEFFICIENTS:
        raise ValueError(f"distortion_model must be one of {', '.join(DISTORTION_MODELS)}, got {model!r}")
    if len(coefficients) not in _COEFFICIENTS[model]:
        *others, last = map(str, _COEFFICIENTS[model])
        counts = f"{', '.join(others)} or {last}" if others else last
        raise ValueError(f"distortion of {model} must have {counts} coefficients, got {len(coefficients)}")


def _distorted(coefficients: tuple[float, ...], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) points at unit depth → (N, 2) distorted."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    x, y = plane[:, 0], plane[:, 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    points = np.empty((len(plane), 2))
    points[:, 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    points[:, 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return points


def _slopes(
    coefficients: tuple[float, ...], plane: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The derivatives of `_distorted`, (N,) each: xx, xy = yx, yy."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    x, y = plane[:, 0], plane[:, 1]
    r2 = x * x + y * y
    over, under = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = over / under
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / under
    mixed = x * y * slope + 2 * p1 * x + 2 * p2 * y
    across = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    along = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return across, mixed, along


@lru_cache(maxsize=16)
def _max_radius(coefficients: tuple[float, ...]) -> float:
    """Distance from the axis at unit depth up to which a pinhole camera's radial distortion ascends."""
    k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    # In the squared radius: the numerator of the slope, and the divisor.
    under = [k6, k5, k4, 1.0]
    slope = np.polysub(
        np.polymul([7 * k3, 5 * k2, 3 * k1, 1.0], under),
        np.polymul([2 * k3, 2 * k2, 2 * k1, 2.0, 0.0], [3 * k6, 2 * k5, k4]),
    )
    roots = [complex(root) for each in (slope, under) for root in np.roots(each)]
    squares = [root.real for root in roots if abs(root.imag) < 1e-12 and root.real > 0.0]
    return math.sqrt(min(squares, default=math.inf))


def _undistorted(
    coefficients: tuple[float, ...], wanted: NDArray[np.float64], plane: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Newton's method from `plane`; NaN where it does not converge, and where the image is folded."""
    largest = _max_radius(coefficients)
    with np.errstate(all="ignore"):
        plane = np.where(np.isfinite(plane), plane, wanted)
        for _ in range(_MAX_STEPS):
            radius = np.sqrt((plane * plane).sum(axis=1, keepdims=True))
            plane = plane * np.minimum(1.0, largest / radius)
            error = _distorted(coefficients, plane) - wanted
            found = np.abs(error).max(axis=1) < _INVERTED
            if found.all():
                break
            xx, xy, yy = _slopes(coefficients, plane)
            step = np.column_stack([yy * error[:, 0] - xy * error[:, 1], xx * error[:, 1] - xy * error[:, 0]])
            plane = np.where(found[:, None], plane, plane - step / (xx * yy - xy * xy)[:, None])
        xx, xy, yy = _slopes(coefficients, plane)  # the tangential distortion may fold it before the radial
        found &= (xx > 0.0) & (xx * yy - xy * xy > 0.0)
    return np.where(found[:, None], plane, np.nan)


def _equidistant(
    coefficients: tuple[float, ...], theta: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angle from the axis → distance from the image's centre at unit focal length, and its derivative."""
    k1, k2, k3, k4 = coefficients
    square = theta * theta
    radius = theta * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    slope = 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
    return radius, slope


@lru_cache(maxsize=16)
def _max_theta(coefficients: tuple[float, ...]) -> float:
    """Angle from the axis up to which an equidistant lens's polynomial ascends, at most π."""
    k1, k2, k3, k4 = coefficients
    roots = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
    turning = [math.sqrt(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0.0]
    return min([math.pi, *turning])


def _equidistant_rays(coefficients: tuple[float, ...], plane: NDArray[np.float64]) -> NDArray[np.float64]:
    largest = _max_theta(coefficients)
    radius = np.sqrt((plane * plane).sum(axis=1))
    theta = np.minimum(radius, largest)
    low, high = np.zeros_like(theta), np.full_like(theta, largest)
    with np.errstate(all="ignore"):
        for _ in range(2 * _MAX_STEPS):
            reached, slope = _equidistant(coefficients, theta)
            if (np.abs(reached - radius) < _INVERTED / 100).all():
                break
            # Newton's step, or half of what is left where that leads out of it.
            low, high = np.where(reached < radius, theta, low), np.where(reached < radius, high, theta)
            step = theta - (reached - radius) / slope
            theta = np.where((step >= low) & (step <= high), step, (low + high) / 2)
        theta[np.abs(_equidistant(coefficients, theta)[0] - radius) > _INVERTED] = np.nan
        sine = np.where(radius > 0.0, np.sin(theta) / radius, 1.0)
    return np.column_stack([plane * sine[:, None], np.cos(theta)])


@dataclass(frozen=True, slots=True)
class CameraMount:
    """Position of the camera on the body (FRD, metres) and rotation from the forward direction.

    A negative pitch looks down. With everything zero the camera looks along the body's forward axis.

    Attributes:
        stabilized: stabilized by a gimbal: roll and pitch are relative to the horizon, yaw to the vehicle's
            heading.
        on_gimbal: pointed by a gimbal: roll, pitch and yaw are relative to the gimbal's frame (FRD, x along
            its axis), whose attitude is given per frame, see `held`.
        ned_from_gimbal: (3, 3) gimbal attitude at one moment, gimbal FRD to NED; None: unknown.

    >>> import math
    >>> import numpy as np
    >>> from vision import CameraMount
    >>> mount = CameraMount(pitch_rad=math.radians(-90.0))
    >>> optical_axis = mount.ned_from_optical(np.eye(3))[:, 2]  # of a level vehicle
    >>> (optical_axis.round(3) + 0.0).tolist()
    [0.0, 0.0, 1.0]
    """

    forward_m: float = 0.0
    right_m: float = 0.0
    down_m: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    stabilized: bool = False
    on_gimbal: bool = False
    ned_from_gimbal: NDArray[np.float64] | None = field(default=None, compare=False)

    def held(self, ned_from_gimbal: NDArray[np.float64]) -> CameraMount:
        """The mount of a camera on a gimbal at one moment, with the gimbal's (3, 3) attitude."""
        return replace(self, ned_from_gimbal=ned_from_gimbal)

    @property
    def position_frd_m(self) -> NDArray[np.float64]:
        """(3,) position of the optical centre in the body frame."""
        return np.array([self.forward_m, self.right_m, self.down_m])

    @property
    def body_from_optical(self) -> NDArray[np.float64]:
        """(3, 3) rotation from the optical frame to the body frame (FRD), for a stabilized one a level body.

        Read-only: cached and shared between equal mounts.

        Raises ValueError for a camera on a gimbal, where it is not constant.
        """
        if self.on_gimbal:
            raise ValueError("a camera on a gimbal has no fixed body_from_optical: use ned_from_optical")
        return self.parent_from_optical

    @property
    def parent_from_optical(self) -> NDArray[np.float64]:
        """(3, 3) rotation from the optical frame to the frame the camera is mounted on; read-only."""
        return _parent_from_optical(self.roll_rad, self.pitch_rad, self.yaw_rad)

    def ned_from_optical(self, ned_from_body: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3, 3) rotation from the optical frame to NED, for the body's (3, 3) attitude.

        Raises ValueError for a camera on a gimbal without `ned_from_gimbal` (see `held`).
        """
        if self.on_gimbal:
            if self.ned_from_gimbal is None:
                raise ValueError("a camera on a gimbal needs the gimbal's attitude: use `held`")
            return self.ned_from_gimbal @ self.parent_from_optical
        if self.stabilized:
            heading_rad = math.atan2(float(ned_from_body[1, 0]), float(ned_from_body[0, 0]))
            ned_from_body = matrix_from_euler(0.0, 0.0, heading_rad)
        return ned_from_body @ self.parent_from_optical


@dataclass(frozen=True, slots=True)
class CameraCalibration:
    """Calibration published by a camera: its lens, and its mount (None: unknown)."""

    model: CameraModel
    mount: CameraMount | None = None


@lru_cache(maxsize=16)
def _parent_from_optical(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """Read-only and cached: needed several times per frame."""
    rotation: NDArray[np.float64] = matrix_from_euler(roll_rad, pitch_rad, yaw_rad) @ BODY_FROM_OPTICAL
    rotation.flags.writeable = False
    return rotation
