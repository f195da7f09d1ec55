"""Names of the dictionaries of printed markers: OpenCV's, AprilTag's, and as boards are labelled."""

from __future__ import annotations

import re

import cv2

# OpenCV has two spellings of some names; the usual one is ours.
DICTIONARIES = tuple(
    sorted(
        name.removeprefix("DICT_")
        for name in dir(cv2.aruco)
        if name.startswith("DICT_")
        and not (name.startswith("DICT_APRILTAG") and "H" in name)
        and not name.endswith("36H12")
    )
)
_PREFIX = re.compile(r"^(cv2?(\.|::))?(aruco(\.|::))?(predefined_dictionary_name\.)?(dict[_ -]?)?")


def dictionary_named(name: str) -> str:
    """The name among DICTIONARIES of what another program calls a dictionary; case does not matter.

    OpenCV writes `DICT_4X4_50` or `cv2.aruco.DICT_APRILTAG_36h11`, AprilTag `tag36h11` or `36h11`.

    Raises:
        ValueError: no such dictionary, or one of several, such as 4X4, of which OpenCV has four lengths.
    """
    plain = _plain(name)
    if plain in _NAMES:
        return _NAMES[plain]
    lengths = lengths_of(name)
    which = f"marker dictionary {name!r} is one of {', '.join(lengths)}: say which" if lengths else ""
    raise ValueError(which or f"unknown marker dictionary {name!r}; known: {', '.join(DICTIONARIES)}")


def lengths_of(name: str) -> tuple[str, ...]:
    """The dictionaries of a family that is named without a length, as boards' labels do, shortest first.

    Each begins with the markers of the shorter ones. Empty: no such family.
    """
    plain = _plain(name)
    found = [each for each in DICTIONARIES if re.fullmatch(rf"{re.escape(plain)}_\d+", each.casefold())]
    return tuple(sorted(found, key=lambda each: int(each.rpartition("_")[2])))


def opencv_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of any of its names. Raises ValueError."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary_named(name)}"))


def _plain(name: str) -> str:
    return re.sub(r"[_ -]+", "_", _PREFIX.sub("", name.strip().casefold()))


def _spellings(name: str) -> tuple[str, ...]:
    plain = name.casefold()
    family = plain.removeprefix("apriltag_").removeprefix("aruco_")
    if plain.startswith("apriltag_"):
        return plain, family, f"tag{family}", f"tag_{family}", f"apriltag{family}"
    return plain, family, f"aruco_{family}", f"aruco{family}"


_NAMES = {spelling: name for name in DICTIONARIES for spelling in _spellings(name)}
