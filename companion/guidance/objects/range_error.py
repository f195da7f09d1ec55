"""One-sigma errors of a range and a direction, propagated from their causes to first order.

Causes are independent of each other: pixels of the box's edges, attitude, height, depth noise, and what is
not known of the object. Errors of several frames are not: most of them change slowly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.vehicle.state import HeightSource
from vision.geolocation import DEPTH_OF_WIDTH

# Attitude. PX4's estimate in its own simulation errs by 0.003 rad of tilt and 0.008 rad of heading (as in
# mavlink_sim/physics/estimate_errors.py). Assumed: 0.005 rad (0.3 degrees) of the camera's mount, and 10 ms
# between the stamps of frame and attitude while the vehicle turns at 0.6 rad/s. The compass of a real
# vehicle, which the simulation lacks: 0.014 rad.
TILT_SIGMA_RAD = 0.0084
HEADING_SIGMA_RAD = 0.0180
# Height above home, if the autopilot states none or less: the drift of PX4's estimate (0.06 m, measured as
# above) and ground that is not level with home.
HOME_SIGMA_M, LEAST_HOME_SIGMA_M = 0.3, 0.1
# Height by a range finder. Data sheet of a common one (Benewake TFmini-S): 0.06 m up to 6 m, 1 % above.
SENSOR_SIGMA_M, SENSOR_SIGMA_SHARE = 0.06, 0.01
# Horizontal position, if the autopilot states none. Data sheet of u-blox M8: CEP 2.5 m, 1.18 sigma.
UNSTATED_POSITION_SIGMA_M = 2.1

# The following are 68 % of the errors of 1928 detected objects in rendered frames, as in
# benchmarks/range_error.py, seeds 21 to 24, with the exact pose.
# Edge of a detected box: a share of the image's width, because the detector sees a smaller image (1.5 pixels
# of 640, image size 320), and of the box's height.
EDGE_SIGMA_OF_WIDTH, EDGE_SIGMA_OF_HEIGHT = 0.0023, 0.01
# Depth of the nearest point, of a stereo camera with a baseline of 5 cm: fixed, and growing with a power of
# the depth: the error of a pixel grows with its square, and fewer pixels are averaged.
DEPTH_SIGMA_M, DEPTH_GROWTH, DEPTH_POWER = 0.07, 3.0e-4, 2.5
# From the ground contact to the nearest surface.
INSET_SIGMA_M = 0.2
# Height of an object of a class with a known height, a share of it.
SIZE_SIGMA_SHARE = 0.1
# The nearest point of a box cut off by the image's edge may be outside: by depth, by the ground.
CUT_DEPTH_SIGMA_M, CUT_GROUND_SIGMA_M = 0.12, 0.4
# Assumed: where an object touches the lower edge of its box, a share of the box's width;
# depth of an object along the line of sight, as a share of its width.
CONTACT_SIGMA, DEPTH_OF_WIDTH_SIGMA = 0.25, 0.4


class PoseError(NamedTuple):
    """One sigma of the vehicle's pose.

    Attributes:
        height_m: of the height above the ground. horizontal_m: of the position, on each axis.
        tilt_rad: of roll and pitch. heading_rad: of the heading.
    """

    height_m: float = HOME_SIGMA_M
    horizontal_m: float = UNSTATED_POSITION_SIGMA_M
    tilt_rad: float = TILT_SIGMA_RAD
    heading_rad: float = HEADING_SIGMA_RAD


class BoxError(NamedTuple):
    """What the errors of a box are made of.

    Attributes:
        pixel_rad: depression of one row, at the box's lower edge.
        column_slope: by how much the range of the ground changes from column to column there, for each metre
            that the ground is below the lens: the image is rolled, or the object is not in its middle.
        width_px, height_px: its size. image_width_px: of the whole image.
        roll_rad: between the image's rows and the horizontal.
        cut: the image's edge cuts it off.
    """

    pixel_rad: float
    column_slope: float
    width_px: float
    height_px: float
    image_width_px: int
    roll_rad: float
    cut: bool

    @property
    def edge_rad(self) -> float:
        """One sigma of an edge."""
        return self.pixel_rad * edge_sigma_px(self.height_px, self.image_width_px)

    @property
    def contact_rad(self) -> float:
        """One sigma of the lower edge as the depression of the object's ground contact."""
        rolled_rad = self.pixel_rad * CONTACT_SIGMA * self.width_px * math.sin(self.roll_rad)
        return math.hypot(self.edge_rad, rolled_rad)


def edge_sigma_px(height_px: float, image_width_px: int) -> float:
    """Error of an edge of a detected box."""
    return math.hypot(EDGE_SIGMA_OF_WIDTH * image_width_px, EDGE_SIGMA_OF_HEIGHT * height_px)


def depth_noise_m(depth_m: float) -> float:
    """Error of the depth of an object's nearest point."""
    return math.hypot(DEPTH_SIGMA_M, DEPTH_GROWTH * max(depth_m, 0.0) ** DEPTH_POWER)


def height_sigma_m(source: HeightSource | None, height_m: float, stated_m: float | None) -> float:
    """Error of the height above the ground.

    Args:
        stated_m: the estimator's own error of the height; None: not stated.
    """
    if source is HeightSource.DISTANCE_SENSOR:
        return math.hypot(SENSOR_SIGMA_M, SENSOR_SIGMA_SHARE * height_m)
    return HOME_SIGMA_M if stated_m is None else max(stated_m, LEAST_HOME_SIGMA_M)


def depth_sigmas_m(
    range_m: float, drop_m: float, depth_m: float, box: BoxError, pose: PoseError
) -> tuple[float, float]:
    """Errors of a horizontal range from depth, and of the straight distance to the point.

    The noise is along the line of sight. The vehicle's height does not matter, its attitude only for the
    range.

    Args:
        drop_m: from the lens down to the point.
        depth_m: along the optical axis.
    """
    noise, cut_m = depth_noise_m(depth_m) / max(depth_m, 1e-3), CUT_DEPTH_SIGMA_M if box.cut else 0.0
    distance_m = max(math.hypot(range_m, drop_m), 1e-3)
    of_range_m = math.hypot(noise * range_m, drop_m * pose.tilt_rad, cut_m)
    return of_range_m, math.hypot(noise * distance_m, cut_m * range_m / distance_m)


def ground_sigmas_m(range_m: float, drop_m: float, box: BoxError, pose: PoseError) -> tuple[float, float]:
    """Errors of a horizontal range from the ground, `drop_m` below the lens, and of the straight distance.

    An error of the height changes range, drop and distance in proportion. The other causes change the range
    alone, and the distance by range / distance of it.
    """
    # range = drop / tan(depression)
    per_rad = range_m**2 / drop_m + drop_m
    of_range_m = math.hypot(
        per_rad * math.hypot(box.edge_rad, pose.tilt_rad),
        drop_m * box.column_slope * CONTACT_SIGMA * box.width_px,
        pose.height_m * range_m / drop_m,
        INSET_SIGMA_M,
        CUT_GROUND_SIGMA_M if box.cut else 0.0,
    )
    level = range_m / math.hypot(range_m, drop_m)
    return of_range_m, math.hypot(level * of_range_m, math.hypot(1.0, level) * pose.height_m)


def size_sigmas_m(
    range_m: float, drop_m: float, size_m: float, box: BoxError, pose: PoseError
) -> tuple[float, float]:
    """Errors of a horizontal range from the known height of an object, and of the distance to its foot.

    The range is that of `range_from_known_height`; distance = range / cos(depression of the foot), whose
    error is taken as independent of the range's.

    Args:
        drop_m: from the lens down to its foot. size_m: the known height.
    """
    # range = size / spread; spread = tan(top) - tan(foot) - share * width * max(-tan(top), 0).
    spread = size_m / range_m
    foot = -drop_m / range_m
    width_rad = box.width_px * box.pixel_rad * math.sqrt(1.0 + foot * foot)
    top, far_edge = spread + foot, 0.0
    if top < 0.0:
        far_edge = DEPTH_OF_WIDTH * width_rad
        top /= 1.0 + far_edge
    of_top, of_foot = (1.0 + top * top) * (1.0 + far_edge), 1.0 + foot * foot
    spread_sigma = math.hypot(
        of_top * box.edge_rad,
        of_foot * box.contact_rad,
        (of_top - of_foot) * pose.tilt_rad,
        DEPTH_OF_WIDTH_SIGMA * width_rad * max(-top, 0.0),
    )
    of_range_m = range_m * math.hypot(SIZE_SIGMA_SHARE, spread_sigma / spread)
    of_foot_m = drop_m * math.hypot(box.edge_rad, pose.tilt_rad)
    return of_range_m, math.hypot(range_m, drop_m) / range_m * math.hypot(of_range_m, of_foot_m)


def depth_sigma_m(depth_m: float, box: BoxError) -> float:
    """Error of the depth of the nearest point along the optical axis."""
    return math.hypot(depth_noise_m(depth_m), CUT_DEPTH_SIGMA_M if box.cut else 0.0)


def across_sigma_m(range_m: float, drop_m: float, box: BoxError, pose: PoseError) -> float:
    """Horizontal error across the line of sight of a point; `drop_m` as above."""
    centre_m = box.edge_rad / math.sqrt(2.0) * math.hypot(range_m, drop_m)  # the mean of two edges
    return math.hypot(range_m * pose.heading_rad, drop_m * pose.tilt_rad, centre_m)
