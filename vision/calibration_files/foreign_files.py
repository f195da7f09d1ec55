"""Calibration files of other programs, as the table of ROS's camera_info YAML.

Kalibr's camchain, OpenCV's FileStorage (YAML and XML), `ros2 topic echo` of a CameraInfo, `ost.txt` and
`ost.ini` of camera_calibration, and lists of numbers as NumPy's `tolist` makes them. What they leave open
is refused.
"""

from __future__ import annotations

import re
from typing import Any
from xml.etree import ElementTree

from vision.calibration_files.lens_names import distortion_name
from vision.plain_yaml import load_plain_yaml

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "mtx", "K", "k")
_COEFFICIENTS = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distortion_coeffs",
    "dist_coeffs",
    "dist_coeff",
    "distCoeffs",
    "dist",
    "D",
    "d",
)
_SIZE = ("image_size", "imageSize", "resolution")


def load_calibration(text: str) -> dict[Any, Any]:
    """Parse a calibration file of any of these programs to the keys of ROS's camera_info YAML.

    Raises:
        ValueError: it is of none of them, or leaves open what the keys mean.
    """
    text = text.removeprefix("\ufeff")
    if "<opencv_storage" in text[:500]:
        return _from_matrices(_opencv_xml(text), "OpenCV's XML file")
    if text.startswith("# oST") or text.lstrip().startswith("[image]"):
        return _ost(text)
    is_opencv = text.startswith("%YAML") or "!!opencv-" in text
    if is_opencv:
        text = re.sub(r"!!opencv-(?:nd-)?matrix", "", re.sub(r"\A%YAML.*\n", "", text))
    # `ros2 topic echo` ends each message with ---.
    content = load_plain_yaml(re.split(r"(?m)^---\s*$", text.strip().removeprefix("---"))[0])
    if not isinstance(content, dict):
        raise ValueError("expected a table with image_width, image_height, camera_matrix…")
    cameras = [key for key, value in content.items() if isinstance(value, dict) and "intrinsics" in value]
    if cameras:
        return _kalibr(content, cameras)
    if isinstance(content.get("camera_matrix"), dict) and not is_opencv:
        return content
    if is_opencv:
        return _from_matrices(content, "OpenCV's YAML file")
    if any(key in content for key in _MATRIX):
        return _from_matrices(content, "the file")
    return content


def _kalibr(content: dict[Any, Any], cameras: list[Any]) -> dict[Any, Any]:
    if len(cameras) > 1:
        raise ValueError(
            f"it is a file of Kalibr with {len(cameras)} cameras ({', '.join(map(str, cameras))}): keep one"
        )
    camera = content[cameras[0]]
    if (kind := camera.get("camera_model")) != "pinhole":
        raise ValueError(
            f"it is a file of Kalibr with the camera model {kind!r}: expected pinhole; calibrate with "
            "companion calibrate, or with Kalibr's pinhole-radtan or pinhole-equi"
        )
    intrinsics = _numbers(camera.get("intrinsics"), "intrinsics")
    if len(intrinsics) != 4:
        raise ValueError(f"{cameras[0]}: intrinsics must be [fx, fy, cx, cy], got {len(intrinsics)} numbers")
    fx, fy, cx, cy = intrinsics
    return _table(
        _size_of(camera, "the file of Kalibr"),
        [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        _numbers(camera.get("distortion_coeffs", []), "distortion_coeffs"),
        camera.get("distortion_model"),
        "the file of Kalibr",
    )


def _from_matrices(content: dict[Any, Any], what: str) -> dict[Any, Any]:
    matrix: Any = next((content[key] for key in _MATRIX if key in content), None)
    if matrix is None:
        raise ValueError(f"{what} has no camera_matrix of one camera; write ROS's camera_info YAML")
    coefficients: Any = next((content[key] for key in _COEFFICIENTS if key in content), [])
    model = content.get("distortion_model")
    if model is None and content.get("fisheye_model") in (1, True):
        model = "equidistant"
    table = _table(
        _size_of(content, what),
        _numbers(matrix, "camera_matrix"),
        _numbers(coefficients, "distortion_coefficients"),
        model,
        what,
    )
    kept = ("camera_name", "rotate_deg", "mirror")
    return table | {key: content[key] for key in kept if key in content}


def _table(
    size: tuple[int, int], matrix: list[float], coefficients: list[float], model: Any, what: str
) -> dict[Any, Any]:
    if model is None:
        # Four are plumb_bob's as well as a fisheye's.
        names = {0: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
        model = names.get(len(distortion_name("rational_polynomial", coefficients)[1]))
        if len(coefficients) not in (0, 5, 8, 12, 14) or model is None:
            raise ValueError(
                f"{what} does not say what its {len(coefficients)} distortion coefficients are: add "
                "distortion_model: plumb_bob, rational_polynomial or equidistant"
            )
    return {
        "image_width": size[0],
        "image_height": size[1],
        "camera_matrix": {"data": matrix},
        "distortion_model": model,
        "distortion_coefficients": {"data": coefficients},
    }


def _size_of(content: dict[Any, Any], what: str) -> tuple[int, int]:
    for width, height in (
        ("image_width", "image_height"),
        ("width", "height"),
    ):
        if width in content and height in content:
            return content[width], content[height]
    for key in _SIZE:
        value = content.get(key)
        if isinstance(value, list) and len(value) == 2:
            return value[0], value[1]
    raise ValueError(f"{what} does not say the size of its images: add image_width and image_height")


def _numbers(value: Any, key: str) -> list[float]:
    """The numbers of a matrix: a list, lists of rows, or OpenCV's table with `data`."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list) and any(isinstance(row, list) for row in value):
        value = [number for row in value for number in (row if isinstance(row, list) else [row])]
    if not isinstance(value, list) or not all(type(number) in (int, float) for number in value):
        raise ValueError(f"{key} must be numbers")
    return list(map(float, value))


def _opencv_xml(text: str) -> dict[str, Any]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("OpenCV's XML file must not define entities")
    try:
        root = ElementTree.fromstring(re.sub(r"\A\s*<\?xml[^>]*\?>", "", text))
    except ElementTree.ParseError as error:
        raise ValueError(f"not well-formed XML: {error}") from None
    content: dict[str, Any] = {}
    for element in root:
        words = "".join((element.findtext("data") or element.text or "").replace(",", " ")).split()
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            content[element.tag] = " ".join(words).strip('"')
            continue
        is_matrix = element.get("type_id", "").startswith("opencv-") or len(numbers) != 1
        whole = [int(number) if number.is_integer() else number for number in numbers]
        content[element.tag] = whole if is_matrix else whole[0]
    return content


def _ost(text: str) -> dict[Any, Any]:
    """`ost.txt` and `ost.ini`: a name in a line, its numbers in those behind it."""
    found: dict[str, list[float]] = {}
    name = ""
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if not words or words[0].startswith("["):
            continue
        try:
            found.setdefault(name, []).extend([float(word) for word in words])
        except ValueError:
            name = " ".join(words)
    missing = [key for key in ("width", "height", "camera matrix", "distortion") if not found.get(key)]
    if missing:
        raise ValueError(f"the file of camera_calibration (ost) has no {', '.join(missing)}")
    size = int(found["width"][0]), int(found["height"][0])
    return _table(size, found["camera matrix"], found["distortion"], None, "the file of camera_calibration")
