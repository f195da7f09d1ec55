"""Whether two positions may be of one object, by their error."""

from __future__ import annotations

# χ² with two degrees of freedom: 99 % of an object's own positions are inside.
GATE = 9.2


def squared_distance(north_m: float, east_m: float, covariance_m2: tuple[float, float, float]) -> float:
    """Mahalanobis distance squared of an offset.

    Args:
        covariance_m2: of the offset: north, north with east, east.
    """
    nn, ne, ee = covariance_m2
    return (ee * north_m * north_m - 2.0 * ne * north_m * east_m + nn * east_m * east_m) / (nn * ee - ne * ne)
