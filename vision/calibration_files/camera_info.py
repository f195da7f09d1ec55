"""Calibration files: ROS's `camera_info` YAML, as camera_calibration writes and image pipelines read it.

Those of other programs are read too, see `foreign_files`.
"""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vision.calibration_files.lens_names import distortion_name
from vision.camera_model import CameraModel, pixels_without_rays
from vision.depth_registration import DepthCalibration
from vision.file_kinds import explained
from vision.home import expanded
from vision.orientation import Orientation
from vision.text_file import read_text

logger = logging.getLogger(__name__)

# The names that `companion calibrate` and ROS's camera_calibration write if none is given.
_DEFAULT_NAMES = ("camera", "narrow_stereo")
# Addresses that name one camera, wherever it is plugged in. By-id names are of maker, model and serial
# number: identical cameras without one share a name.
_IDENTITIES = ("/dev/v4l/by-id/", "realsense://", "oak://")
# Largest error of a product of rows of a rotation.
_NO_ROTATION = 1e-3


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What a calibration file says.

    Attributes:
        path: of the file.
        model: size, camera matrix and distortion.
        name: of the camera; None if it has none, or a program's default.
        orientation: how the images were turned before the calibration; None if the file does not say.
        registration: of a depth camera to its colour camera, as `companion calibrate lens` writes it.
    """

    path: Path
    model: CameraModel
    name: str | None
    orientation: Orientation | None
    registration: DepthCalibration | None = None

    def check_source(self, orientation: Orientation, name: str | None = None, uri: str | None = None) -> None:
        """Check that the calibration is of this source's images.

        Args:
            name: of the camera, compared with a file's name. uri: the source, compared where the file's name
                is an address that identifies a camera, see `camera_identity`: devices of this computer by
                where their addresses lead, others only if this one identifies a camera too.

        Raises:
            ValueError: the source is turned otherwise, or is another camera; one line that names both.
        """
        own = self.orientation
        for key in ("rotate_deg", "mirror"):
            if own is not None and (value := getattr(own, key)) != getattr(orientation, key):
                raise ValueError(
                    f"the calibration file {self.path} has {key} {_text(value)}, but source.{key} is "
                    f"{_text(getattr(orientation, key))}: calibrate with the same --rotate and --mirror, or "
                    f"correct one of them"
                )
        key, given = "source.name", name
        if self.name is not None and camera_identity(self.name) is not None:
            key, given = "the source", None if uri is None or _same_camera(self.name, uri) else uri
        if self.name is not None and given is not None and self.name != given:
            raise ValueError(
                f"the calibration file {self.path} is the calibration of another camera: camera_name is "
                f"{self.name!r}, {key} {given!r}"
            )


def camera_identity(uri: str) -> str | None:
    """A source's address where it identifies one camera: by-id of V4L2, or a maker's serial number."""
    return uri if any(uri.startswith(prefix) and uri != prefix for prefix in _IDENTITIES) else None


def _same_camera(identity: str, uri: str) -> bool:
    """Whether two addresses may be of one camera."""
    # One device may have several by-id names, and every one has a number.
    nodes = _node(identity), _node(uri)
    if None not in nodes:
        return nodes[0] == nodes[1]
    return camera_identity(uri) in (None, identity)


def _node(uri: str) -> str | None:
    """The device file that an address leads to; None: of no device, or of one that is not plugged in."""
    path = f"/dev/video{int(uri)}" if uri.isdecimal() else uri
    return os.path.realpath(path) if path.startswith("/dev/") and os.path.exists(path) else None


def write_camera_info(
    path: Path,
    model: CameraModel,
    name: str,
    notes: tuple[str, ...] = (),
    orientation: Orientation | None = None,
    registration: DepthCalibration | None = None,
) -> None:
    """Write a calibration file.

    Args:
        name: of the camera, `camera_name` in the file.
        orientation: how the images were turned, written as keys that ROS ignores; None: not written.
        registration: of a depth camera, `model`'s, to its colour camera: more such keys.
        notes: lines of comment at its beginning.

    Raises:
        OSError: the file cannot be written.
    """
    projection = [model.fx, 0.0, model.cx, 0.0, 0.0, model.fy, model.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    lines = [
        *(f"# {note}" for note in notes),
        *_lens_lines(model),
        f"camera_name: {name}",
        *_matrix("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        *_matrix("projection_matrix", 3, 4, projection),
    ]
    if orientation is not None:
        lines += [f"rotate_deg: {orientation.rotate_deg}", f"mirror: {_text(orientation.mirror)}"]
    if registration is not None:
        places = np.column_stack([registration.rotation, registration.position_m])
        lines += _matrix("colour_from_depth", 3, 4, places.ravel().tolist())
        lines += _lens_lines(registration.colour, "colour_")
    path.write_text("\n".join(lines) + "\n", "utf-8")


def read_camera_info(path: Path) -> CameraInfo:
    """Read a calibration file, also one of Kalibr or OpenCV.

    Raises:
        ValueError: it cannot be read, is not such a file, or has an unknown distortion model; one line that
            names the file.
    """
    # The YAML reader takes 30 ms to import, and every program with settings imports this module.
    from vision.calibration_files.foreign_files import load_calibration

    try:
        content = load_calibration(read_text(path))
        model = _lens(content)
        if problem := pixels_without_rays(model):
            _warn(f"the calibration file {path}: {problem}")
        name = str(content.get("camera_name") or "")
        known = None if name in ("", *_DEFAULT_NAMES) else name
        return CameraInfo(path, model, known, _orientation(content), _registration(content, model))
    except OSError as error:
        raise ValueError(f"cannot read the calibration file {path}: {error.strerror}") from None
    except ValueError as error:  # UnicodeDecodeError and PlainYamlError are too
        problem = f"the calibration file {path} cannot be used: {error}"
        raise ValueError(explained(path, problem)) from None


@lru_cache(maxsize=16)
def _warn(text: str) -> None:
    """Once: settings are read several times."""
    logger.warning("%s", text)


def _lens_lines(model: CameraModel, prefix: str = "") -> list[str]:
    k = [model.fx, 0.0, model.cx, 0.0, model.fy, model.cy, 0.0, 0.0, 1.0]
    return [
        f"{prefix}image_width: {model.width}",
        f"{prefix}image_height: {model.height}",
        *_matrix(f"{prefix}camera_matrix", 3, 3, k),
        f"{prefix}distortion_model: {model.distortion_model}",
        *_matrix(f"{prefix}distortion_coefficients", 1, len(model.coefficients), model.coefficients),
    ]


def _lens(content: dict[Any, Any], prefix: str = "") -> CameraModel:
    matrix = _numbers(content, f"{prefix}camera_matrix", 9)
    if matrix[1] != 0.0 or matrix[3] != 0.0 or matrix[6:] != (0.0, 0.0, 1.0):
        raise ValueError(f"{prefix}camera_matrix must be [fx, 0, cx, 0, fy, cy, 0, 0, 1], got {list(matrix)}")
    model, coefficients = distortion_name(
        _value(content, f"{prefix}distortion_model"), _numbers(content, f"{prefix}distortion_coefficients")
    )
    return CameraModel(
        _size(content, f"{prefix}image_width"),
        _size(content, f"{prefix}image_height"),
        *(matrix[0], matrix[4], matrix[2], matrix[5]),
        coefficients,
        model,
    )


def _registration(content: dict[Any, Any], depth: CameraModel) -> DepthCalibration | None:
    if "colour_from_depth" not in content:
        return None
    places = np.array(_numbers(content, "colour_from_depth", 12)).reshape(3, 4)
    rotation = places[:, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _NO_ROTATION or np.linalg.det(rotation) < 0.0:
        raise ValueError("colour_from_depth must be three rows of a rotation and a position in metres")
    return DepthCalibration(depth, _lens(content, "colour_"), rotation, places[:, 3])


def read_registration(file: str, orientation: Orientation) -> DepthCalibration:
    """Read the calibration of a depth camera to its colour camera.

    Raises:
        ValueError: as `read_camera_info`, the file has none, or its images are turned otherwise.
    """
    info = read_camera_info(expanded(file))
    info.check_source(orientation)
    if info.registration is None:
        raise ValueError(
            f"the calibration file {file} has no colour_from_depth: write it with companion calibrate lens "
            "--depth-source"
        )
    return info.registration


def _matrix(key: str, rows: int, columns: int, values: tuple[float, ...] | list[float]) -> list[str]:
    data = ", ".join(f"{value:.10g}" for value in values)
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{data}]"]


def _orientation(content: dict[Any, Any]) -> Orientation | None:
    if not content.keys() & {"rotate_deg", "mirror"}:
        return None
    rotate_deg, mirror = content.get("rotate_deg", 0), content.get("mirror", False)
    if isinstance(rotate_deg, bool) or not isinstance(rotate_deg, int) or not isinstance(mirror, bool):
        raise ValueError(
            f"rotate_deg must be 0, 90, 180 or 270, mirror true or false, got {rotate_deg!r} and {mirror!r}"
        )
    return Orientation(rotate_deg, mirror)


def _text(value: int | bool) -> str:
    return str(value).lower()


def _value(content: dict[Any, Any], key: str) -> Any:
    if key not in content:
        raise ValueError(f"{key} is missing")
    return content[key]


def _size(content: dict[Any, Any], key: str) -> int:
    value = _value(content, key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{key} must be a number of pixels, got {value!r}")
    return value


def _numbers(content: dict[Any, Any], key: str, count: int | None = None) -> tuple[float, ...]:
    table = _value(content, key)
    data = table.get("data") if isinstance(table, dict) else None
    if not isinstance(data, list) or not all(_is_number(value) for value in data):
        raise ValueError(f"{key} must have data: [numbers]")
    if count is not None and len(data) != count:
        raise ValueError(f"{key} must have {count} numbers, got {len(data)}")
    return tuple(float(value) for value in data)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
