"""ArUco and AprilTag markers printed on plates: their cells, and their pixels in a camera.

A pixel's brightness is the mean over sample points, each looked up in the marker's cells, so that edges of
cells are as soft as in a camera and corners are geometrically exact. Markers of Garrido-Jurado et al. 2014
and Olson 2011, from OpenCV's dictionaries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.world.structures import PLATE_THICKNESS_M
from mavlink_sim.world.textures import Plane
from vision.marker_dictionaries import dictionary_named, opencv_dictionary

QUIET_CELLS = 1
"""White cells around the black square: a detector needs them."""
BLACK = 0.07
"""Reflectance of printed black relative to the board."""
MANY_PIXELS, VERY_MANY_PIXELS = 12_000, 60_000


@dataclass(frozen=True, slots=True)
class Print:
    """The print on a plate.

    Attributes:
        dictionary: "4X4_50" or "APRILTAG_36h11"; given by any name of `dictionary_named`.
        identifier: of the marker in its dictionary.
        size_m: side of the marker's black square.
        standing: on its lower edge, its front along the yaw; else lying face up, its upper edge along it.

    Raises:
        ValueError: an unknown dictionary or marker, or an invalid size.
    """

    dictionary: str
    identifier: int
    size_m: float
    standing: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "dictionary", dictionary_named(self.dictionary))
        count = len(opencv_dictionary(self.dictionary).bytesList)
        if not 0 <= self.identifier < count:
            raise ValueError(
                f"marker {self.identifier} is not in dictionary {self.dictionary}, which has 0 to {count - 1}"
            )
        if not 0.01 <= self.size_m <= 50.0:
            raise ValueError(f"a marker's size must be 0.01 to 50 m, got {self.size_m}")

    @property
    def board_side_m(self) -> float:
        """Side of the plate: the marker with its white margin."""
        cells = opencv_dictionary(self.dictionary).markerSize + 2
        return self.size_m * (cells + 2 * QUIET_CELLS) / cells

    @property
    def board_size_m(self) -> tuple[float, float, float]:
        """Length, width and height of the plate in its own frame."""
        side = self.board_side_m
        return (PLATE_THICKNESS_M, side, side) if self.standing else (side, side, PLATE_THICKNESS_M)


@lru_cache(maxsize=256)
def marker_cells(dictionary: str, identifier: int) -> Plane:
    """(N, N) float32 reflectance of the plate's cells, margin included, as seen upright."""
    book = opencv_dictionary(dictionary)
    cells = book.markerSize + 2
    image = cv2.aruco.generateImageMarker(book, identifier, cells, borderBits=1)
    whole = np.pad(np.asarray(image), QUIET_CELLS, constant_values=255)
    return np.where(whole > 127, np.float32(1.0), np.float32(BLACK)).astype(np.float32)


def printed_side(printed: Print) -> NDArray[np.float64]:
    """(3,) outward normal of the printed face in the plate's frame: x forward, y right, z down."""
    return np.array([1.0, 0.0, 0.0]) if printed.standing else np.array([0.0, 0.0, -1.0])


def reflectance(
    printed: Print, eye: NDArray[np.float64], plate_from_pixel: NDArray[np.float64], x: Plane, y: Plane
) -> Plane:
    """(N,) mean reflectance of the print over each pixel.

    Args:
        eye: (3,) the camera in the plate's frame.
        plate_from_pixel: (3, 3) takes (u, v, 1) to a ray in the plate's frame.
        x, y: (N,) pixels of the printed face.
    """
    cells = marker_cells(printed.dictionary, printed.identifier)
    count, side = len(cells), printed.board_side_m
    height = PLATE_THICKNESS_M / 2 if printed.standing else -PLATE_THICKNESS_M
    axis = 0 if printed.standing else 2
    # Rows of the homography: the ray meets the face at eye + ray · (height − eye[axis]) / ray[axis].
    reach = height - eye[axis]
    origin, ray = eye, plate_from_pixel
    if printed.standing:  # seen from the front: to the right is −y, downwards +z, the upper edge at z = −side
        across = (-origin[1] * ray[0] - reach * ray[1], side / 2)
        down = (origin[2] * ray[0] + reach * ray[2], side)
    else:  # seen from above: to the right is +y, downwards −x
        across = (origin[1] * ray[2] + reach * ray[1], side / 2)
        down = (-origin[0] * ray[2] - reach * ray[0], side / 2)
    below = ray[axis]
    cells_per_m = count / side
    columns = ((across[0] + across[1] * below) * cells_per_m).astype(np.float64)
    rows = ((down[0] + down[1] * below) * cells_per_m).astype(np.float64)
    grid = 4 if len(x) < MANY_PIXELS else 3 if len(x) < VERY_MANY_PIXELS else 2
    offsets = (np.arange(grid) + 0.5) / grid - 0.5
    total = np.zeros(len(x), np.float32)
    flat = cells.ravel()
    u, v = x.astype(np.float64), y.astype(np.float64)
    # At the pixels' centres; each sample point adds a constant.
    depth = below[0] * u + below[1] * v + below[2]
    column_depth = columns[0] * u + columns[1] * v + columns[2]
    row_depth = rows[0] * u + rows[1] * v + rows[2]
    last = count - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        for right in offsets:
            for lower in offsets:
                scale = 1.0 / (depth + (below[0] * right + below[1] * lower))
                column = (column_depth + (columns[0] * right + columns[1] * lower)) * scale
                row = (row_depth + (rows[0] * right + rows[1] * lower)) * scale
                # fmax ignores NaN: a ray along the face
                column = np.fmin(np.fmax(column, 0.0), last).astype(np.int32)
                row = np.fmin(np.fmax(row, 0.0), last).astype(np.int32)
                total += flat.take(row * np.int32(count) + column)
    total /= np.float32(grid * grid)
    return total
