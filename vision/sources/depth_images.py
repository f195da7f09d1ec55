"""Depth images as files and pipes hold them, and their conversion to metres."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.extras import install_command
from vision.file_kinds import kind_of_bytes
from vision.image_file import ImageError
from vision.sources.source import SourceError

DEPTH_SUFFIXES = frozenset((".png", ".pgm", ".tif", ".tiff", ".exr", ".npy"))
INTEGER_SCALE_M, FLOAT_SCALE_M = 0.001, 1.0
"""Metres per unit without `depth_scale`: 16-bit integers are millimetres, floats metres."""
# Floats in millimetres are common, and depth cameras for vehicles do not see this far.
IMPLAUSIBLE_MEDIAN_M = 200.0
# Integers in metres: as millimetres all of the image is nearer than any depth camera sees.
IMPLAUSIBLE_LARGEST_M = 0.03
# The channel of depth in an OpenEXR file with several, as renderers name it. Files with layers have the
# layer's name and a dot before it.
_EXR_CHANNEL = "Z"
_DEPTH_KINDS = ("is a PNG", "is a TIFF", "is an array of NumPy")


def is_depth_image(path: Path) -> bool:
    """Whether the file name has the suffix of a depth image."""
    return path.suffix.lower() in DEPTH_SUFFIXES


def read_depth(path: Path) -> NDArray[Any]:
    """`decode_depth` of a file.

    Raises:
        ImageError: it cannot be read. SourceError: as `decode_depth`.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError(f"cannot be read: {error.strerror or error}") from None
    image = decode_depth(path, data)
    if image is None:
        problem = "not a depth image that can be read; it may be truncated or damaged"
        kind = kind_of_bytes(data[:65_536])
        raise ImageError(problem if kind is None or kind.startswith(_DEPTH_KINDS) else kind)
    return image


def decode_depth(path: Path, data: bytes) -> NDArray[Any] | None:
    """(height, width) uint16 or float of a file's bytes, in the file's units; None if it cannot be read.

    Raises:
        SourceError: it holds something else than one channel of 16-bit integers or floats; or it is OpenEXR
            and the extra is missing, or not exactly one of several channels is `Z` or `LAYER.Z`.
    """
    image: Any = None
    if path.suffix.lower() == ".exr":
        image = _decode_exr(path, data)
    elif path.suffix.lower() == ".npy":
        try:
            image = np.load(io.BytesIO(data), allow_pickle=False)
        except (ValueError, EOFError, OSError):
            return None
        if not isinstance(image, np.ndarray):  # an archive of several
            return None
    elif data:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
    if image is None:
        return None
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    image = image.astype(image.dtype.newbyteorder("="), copy=False)
    if image.ndim != 2 or not (image.dtype == np.uint16 or image.dtype.kind == "f"):
        raise SourceError(
            f"{path}: depth must be one channel of 16-bit integers or floats, got shape {image.shape} "
            f"{image.dtype}"
        )
    return np.asarray(image)


def _decode_exr(path: Path, data: bytes) -> NDArray[Any] | None:
    """The only channel of an OpenEXR file's first part, or `Z`; None if it cannot be read.

    OpenEXR prints about damaged pixels itself; its Python interface has no setting against it.
    """
    try:
        import OpenEXR
    except ImportError as error:
        raise SourceError(
            f"{path}: needs OpenEXR: {install_command('OpenEXR')} ({error}); or convert it to 32-bit "
            f"TIFF or NPY"
        ) from error
    try:
        channels = OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()
    except (RuntimeError, ValueError):
        return None
    found = [name for name in channels if len(channels) == 1 or name.rpartition(".")[2] == _EXR_CHANNEL]
    if len(found) != 1:
        raise SourceError(
            f"{path}: depth must be the only channel or the only {_EXR_CHANNEL!r}, got "
            f"{', '.join(sorted(channels))}"
        )
    return np.asarray(channels[found[0]].pixels)


def to_metres(image: NDArray[Any], scale_m: float | None) -> NDArray[np.float32]:
    """(height, width) float32 metres, NaN for holes: 0, 65535 of integers, negative, NaN and infinity.

    Args:
        image: (height, width), uint16 or float.
        scale_m: metres per unit; None: by the type, see INTEGER_SCALE_M.

    Raises:
        SourceError: it is in another unit: half of a float image is farther than 200 m, or all of an integer
            image without `scale_m` nearer than 0.03 m.
    """
    integer = image.dtype.kind == "u"
    scale = (INTEGER_SCALE_M if integer else FLOAT_SCALE_M) if scale_m is None else scale_m
    with np.errstate(over="ignore", invalid="ignore"):
        depth_m = image.astype(np.float32) * np.float32(scale)
        known = (depth_m > 0.0) & (depth_m < np.inf)
    if integer:  # a sensor's "no measurement"
        known &= image != np.iinfo(image.dtype).max
    depth_m[~known] = np.nan
    if integer and scale_m is None and known.mean() > 0.5:
        largest_m = float(np.max(depth_m[known]))
        if largest_m < IMPLAUSIBLE_LARGEST_M:
            raise SourceError(
                f"the largest depth is {largest_m:.3f} m; integers are millimetres unless source.depth_scale "
                f"(metres per unit) says otherwise: for metres set it to 1"
            )
    if not integer and known.any():
        median_m = float(np.median(depth_m[known]))
        if median_m > IMPLAUSIBLE_MEDIAN_M:
            raise SourceError(
                f"the median of depth is {median_m:.0f} m; floats are metres unless source.depth_scale "
                f"(metres per unit) says otherwise: for millimetres set it to 0.001"
            )
    return depth_m
