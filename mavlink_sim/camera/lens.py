"""From a rendered pinhole image to that of a real camera: distortion, rolling shutter, blur.

The pinhole image is drawn a little larger than the camera's; every pixel of the camera is then mapped to the
intersection of its ray, bent by the lens and rotated by the camera's motion until that row was read out. For
the rotation this is exact (Forssén and Ringaby 2010, "Rectifying rolling shutter video"); for the translation
it is exact within a surface, as the depth is that of the pixel in the middle of the readout: outlines of near
objects before far ones are skewed by the rotation, but not by the translation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.world.textures import Image, Plane
from vision.camera_model import MIN_COSINE, CameraModel

MARGIN_SHARE = 0.1
"""Margin drawn on every side for a moving camera's rows, as a share of the width."""
MAX_GROWTH = 2.5
MOST_EXPOSURES = 8


@dataclass(frozen=True, slots=True)
class Shutter:
    """The timing of an image.

    Attributes:
        exposure_s: exposure time of each row; motion during it blurs.
        readout_s: from the first row's exposure to the last row's, 0 for a global shutter.
    """

    exposure_s: float = 0.0
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("exposure_s", self.exposure_s), ("readout_s", self.readout_s)):
            if not 0.0 <= value <= 0.5:
                raise ValueError(f"a shutter's {name} must be 0 to 0.5 s, got {value}")


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """The camera's motion at the middle of the exposure, in its optical frame (x right, y down).

    Attributes:
        velocity_mps: of the optical centre.
        angular_velocity_radps: of the camera.
    """

    velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular_velocity_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def still(self) -> bool:
        """Whether nothing moves."""
        return not any(self.velocity_mps) and not any(self.angular_velocity_radps)


class Lens:
    """The lens and shutter of one camera, applied to pinhole images.

    Attributes:
        drawn: the pinhole camera of the images for `expose`.

    Raises (when made):
        ValueError: the distortion is not invertible over the whole image, or needs a far larger pinhole
        image.
    """

    def __init__(self, camera: CameraModel, shutter: Shutter | None = None) -> None:
        self.camera, self.shutter = camera, shutter or Shutter()
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
        plane = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        if not camera.rectilinear:
            plane = _undistorted(camera, pixels)
        shape = (camera.height, camera.width)
        self._x = plane[:, 0].reshape(shape).astype(np.float32)
        self._y = plane[:, 1].reshape(shape).astype(np.float32)
        moving = self.shutter.exposure_s > 0.0 or self.shutter.readout_s > 0.0
        margin = math.ceil(MARGIN_SHARE * camera.width) if moving else 1
        # Whole pixels more on each side, so that without distortion and motion no pixel is interpolated.
        left = math.ceil(-float(self._x.min()) * camera.fx - camera.cx) + margin
        right = math.ceil(float(self._x.max()) * camera.fx + camera.cx) + 1 - camera.width + margin
        top = math.ceil(-float(self._y.min()) * camera.fy - camera.cy) + margin
        bottom = math.ceil(float(self._y.max()) * camera.fy + camera.cy) + 1 - camera.height + margin
        width, height = left + camera.width + right, top + camera.height + bottom
        if width > MAX_GROWTH * camera.width or height > MAX_GROWTH * camera.height:
            raise ValueError(
                f"the distortion {camera.distortion} needs a pinhole image of "
                f"{width}x{height}, more than {MAX_GROWTH} times {camera.width}x{camera.height}; "
                "use weaker coefficients or a longer focal length"
            )
        self.drawn = CameraModel(width, height, camera.fx, camera.fy, camera.cx + left, camera.cy + top)
        still_x = self._x * np.float32(camera.fx) + np.float32(self.drawn.cx)
        still_y = self._y * np.float32(camera.fy) + np.float32(self.drawn.cy)
        self._still_map = (still_x, still_y)
        self._still_index = self._nearest(still_x, still_y)
        self._still_seen = self._seen(self._still_index)

    def expose(
        self, image: Image, inverse_depth: Plane, labels: NDArray[np.int32], motion: CameraMotion
    ) -> tuple[Image, Plane, NDArray[np.int32], NDArray[np.bool_]]:
        """The camera's image of a pinhole image of the size `drawn`.

        Returns:
            The image (H, W, 3); the reciprocal depth and the labels (H, W) at the middle of each row's
            exposure, of the nearest pixel; and the mask of the pinhole image's visible pixels.
        """
        shutter = self.shutter
        index, seen, (map_x, map_y) = self._still_index, self._still_seen, self._still_map
        times = [0.0]
        if not motion.still:
            still_inverse = inverse_depth.reshape(-1).take(index)
            if shutter.readout_s > 0.0:
                map_x, map_y = self._moved(motion, 0.0, still_inverse)
                index = self._nearest(map_x, map_y)
                seen = self._seen(index)
            if shutter.exposure_s > 0.0:
                times = self._exposures(motion, still_inverse)
        # OpenCV 5.0 remaps four channels in half the time of three; 4.10 takes as long as with three.
        four = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2BGRA), np.uint8)
        if len(times) == 1:
            exposed = _look_up(four, map_x, map_y)
        else:
            total = np.zeros((*self._x.shape, 4), np.float32)
            for time_s in times:
                cv2.accumulate(_look_up(four, *self._moved(motion, time_s, still_inverse)), total)
            exposed = np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / len(times)), np.uint8)
        exposed = np.asarray(cv2.cvtColor(exposed, cv2.COLOR_BGRA2BGR), np.uint8)
        return exposed, inverse_depth.reshape(-1).take(index), labels.reshape(-1).take(index), seen

    def _seen(self, index: NDArray[np.intp]) -> NDArray[np.bool_]:
        """The mask of the pinhole image's pixels that the camera sees."""
        seen = np.zeros((self.drawn.height, self.drawn.width), np.uint8)
        seen.reshape(-1)[index] = 1
        # A pixel of the camera may cover several of the pinhole image.
        return np.asarray(cv2.dilate(seen, np.ones((3, 3), np.uint8)), np.bool_)

    def _nearest(self, map_x: Plane, map_y: Plane) -> NDArray[np.intp]:
        """(H, W) flat indices of the nearest pixels of the pinhole image, at its border if beyond it."""
        columns = np.clip(np.rint(map_x), 0, self.drawn.width - 1).astype(np.intp)
        rows = np.clip(np.rint(map_y), 0, self.drawn.height - 1).astype(np.intp)
        return rows * self.drawn.width + columns

    def _moved(self, motion: CameraMotion, time_s: float, inverse_depth: Plane) -> tuple[Plane, Plane]:
        """The point in the pinhole image of each pixel, `time_s` after the middle of its row's exposure."""
        camera = self.camera
        height = camera.height
        row_times = time_s + self.shutter.readout_s * ((np.arange(height) + 0.5) / height - 0.5)
        turned = _rotations(np.array(motion.angular_velocity_radps), row_times).astype(np.float32)
        shift = np.multiply.outer(row_times, np.array(motion.velocity_mps)).astype(np.float32)
        x, y = self._x, self._y
        rays = [
            turned[:, axis, 0, None] * x
            + turned[:, axis, 1, None] * y
            + turned[:, axis, 2, None]
            + shift[:, axis, None] * inverse_depth
            for axis in range(3)
        ]
        ahead = np.maximum(rays[2], np.float32(1e-3))
        map_x = rays[0] / ahead * np.float32(self.drawn.fx) + np.float32(self.drawn.cx)
        map_y = rays[1] / ahead * np.float32(self.drawn.fy) + np.float32(self.drawn.cy)
        return map_x, map_y

    def _exposures(self, motion: CameraMotion, inverse_depth: Plane) -> list[float]:
        """Times within the exposure, at most about a pixel and a half of motion apart."""
        half = self.shutter.exposure_s / 2
        first, last = self._moved(motion, -half, inverse_depth), self._moved(motion, half, inverse_depth)
        step = (slice(None, None, 16), slice(None, None, 16))
        travel = np.hypot(last[0][step] - first[0][step], last[1][step] - first[1][step])
        count = min(MOST_EXPOSURES, math.ceil(float(np.percentile(travel, 90)) / 1.5))
        if count <= 1:
            return [0.0]
        return [half * (2 * (number + 0.5) / count - 1.0) for number in range(count)]


def _look_up(image: Image, map_x: Plane, map_y: Plane) -> Image:
    looked = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(looked, np.uint8)


def _rotations(rate_radps: NDArray[np.float64], times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3, 3) rotations by `rate` · time (Rodrigues' formula)."""
    rate = float(np.linalg.norm(rate_radps))
    if rate < 1e-12:
        return np.tile(np.eye(3), (len(times_s), 1, 1))
    x, y, z = rate_radps / rate
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = (rate * times_s)[:, None, None]
    turned: NDArray[np.float64] = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return turned


def _undistorted(camera: CameraModel, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) pixels → (N, 2) on the plane at depth 1 that the lens bends there."""
    rays = camera.rays(pixels)
    if not np.isfinite(rays).all():
        raise ValueError(
            f"the distortion {camera.distortion} is not invertible within {camera.width}x{camera.height}: "
            f"{np.isnan(rays[:, 0]).mean():.1%} of the pixels have no ray; use weaker coefficients"
        )
    if not (rays[:, 2] > MIN_COSINE).all():
        raise ValueError(
            f"the {camera.distortion_model} lens sees 180 degrees or more, which no pinhole image shows; "
            "use a longer focal length"
        )
    return np.asarray(rays[:, :2] / rays[:, 2:], np.float64)
