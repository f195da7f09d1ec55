"""Other programs' names of the distortion models, and coefficients that end in zeros."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vision.camera_model import EQUIDISTANT, PLUMB_BOB, RATIONAL

_NAMES = {
    "radtan": PLUMB_BOB,
    "radial_tangential": PLUMB_BOB,
    "none": PLUMB_BOB,
    "fisheye": EQUIDISTANT,
    "equi": EQUIDISTANT,
    "rational": RATIONAL,
}
_PADDED = (8, 12, 14)
_LONGEST = {PLUMB_BOB: 5, RATIONAL: 8, EQUIDISTANT: 4}


def distortion_name(name: Any, coefficients: Sequence[float]) -> tuple[Any, tuple[float, ...]]:
    """The name that ROS has for a distortion model, and its coefficients without the zeros that fill them up.

    Eight of plumb_bob (Orbbec, MRPT) and 12 or 14 of OpenCV are those of the smaller model if the rest are 0.
    What is not known is returned as it is.
    """
    if isinstance(name, str):
        plain = name.strip().lower().replace(" ", "_").replace("-", "_")
        name = _NAMES.get(plain, plain if plain in _LONGEST else name)
    values = tuple(coefficients)
    longest = _LONGEST.get(name, len(values)) if isinstance(name, str) else len(values)
    if len(values) in _PADDED and not any(values[longest:]):
        values = values[:longest]
    return name, values
