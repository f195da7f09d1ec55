"""Calibration files of other programs."""

from __future__ import annotations

from pathlib import Path

import pytest

from vision.calibration_files.camera_info import read_camera_info

_K = "600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0"
_D = "0.1, -0.2, 0.001, 0.002, 0.0"
_ROS = (
    "image_width: 640\nimage_height: 480\ncamera_matrix: {{rows: 3, cols: 3, data: [" + _K + "]}}\n"
    "distortion_model: {}\ndistortion_coefficients: {{rows: 1, cols: 5, data: [{}]}}\n"
)
_KALIBR = (
    "cam0:\n  camera_model: {}\n  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]\n  distortion_model: {}\n"
    "  intrinsics: [600.0, 600.0, 320.0, 240.0]\n  resolution: [640, 480]\n"
)
_OPENCV = (
    "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
    "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
    f"   dt: d\n   data: [ {_K} ]\n"
    "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
    f"   data: [ {_D} ]\n"
)
_XML = (
    '<?xml version="1.0"?>\n<opencv_storage>\n'
    "<image_width>640</image_width><image_height>480</image_height>\n"
    '<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>\n'
    f"{_K.replace(',', '')}</data></camera_matrix>\n"
    '<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>5</cols><dt>d</dt><data>\n'
    f"{_D.replace(',', '')}</data></distortion_coefficients></opencv_storage>\n"
)
_ECHO = (
    "header:\n  stamp: {sec: 1, nanosec: 2}\n  frame_id: camera\nheight: 480\nwidth: 640\n"
    "distortion_model: plumb_bob\nd:\n"
    + "".join(f"- {each}\n" for each in _D.split(", "))
    + "k:\n"
    + "".join(f"- {each}\n" for each in _K.split(", "))
    + "binning_x: 0\n---\n"
)
_INI = (
    "# oST version 5.0 parameters\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n"
    "[narrow_stereo]\n\ncamera matrix\n"
    "600.0 0.0 320.0\n0.0 600.0 240.0\n0.0 0.0 1.0\n\n"
    "distortion\n0.1 -0.2 0.001 0.002 0.0\n\nrectification\n1 0 0\n"
)
_LISTS = (
    "image_size: [640, 480]\ncamera_matrix: [[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]\n"
    f"dist_coeff: [[{_D}]]\n"
)
READ = {
    "radtan": (_ROS.format("radtan", "0.1, -0.2, 0.001, 0.002"), "plumb_bob"),
    "Plumb Bob": (_ROS.format("Plumb Bob", _D), "plumb_bob"),
    "fisheye": (_ROS.format("fisheye", "0.1, -0.2, 0.001, 0.002"), "equidistant"),
    "eight of plumb_bob": (_ROS.format("plumb_bob", f"{_D}, 0.0, 0.0, 0.0"), "plumb_bob"),
    "fourteen of rational": (
        _ROS.format("rational_polynomial", ", ".join([_D, *["0.0"] * 9])),
        "rational_polynomial",
    ),
    "kalibr": (_KALIBR.format("pinhole", "radtan"), "plumb_bob"),
    "kalibr fisheye": (_KALIBR.format("pinhole", "equidistant"), "equidistant"),
    "opencv yaml": (_OPENCV, "plumb_bob"),
    "opencv xml": (_XML, "plumb_bob"),
    "ros2 topic echo": (_ECHO, "plumb_bob"),
    "ost": (_INI, "plumb_bob"),
    "lists": (_LISTS, "plumb_bob"),
}
REFUSED = {
    "omni": (_KALIBR.format("omni", "radtan"), "pinhole"),
    "two cameras": (_KALIBR.format("pinhole", "radtan") * 2, "cam0"),
    "no size": (_LISTS.replace("image_size", "other"), "image_width"),
    "four of unknown model": (_LISTS.replace(", 0.0]]\n", "]]\n"), "distortion_model"),
    "eight that are not zero": (_ROS.format("plumb_bob", f"{_D}, 0.1, 0.0, 0.0"), "coefficients"),
    "entities": (_XML.replace("<opencv_storage>", "<!DOCTYPE a><opencv_storage>"), "entities"),
    "html": ("<!DOCTYPE html><html></html>", "HTML"),
}


@pytest.mark.parametrize(("text", "model"), READ.values(), ids=list(READ))
def test_calibration_of_another_program_is_read(text: str, model: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    lens = read_camera_info(path).model
    assert (lens.width, lens.height) == (640, 480)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (600.0, 600.0, 320.0, 240.0)
    assert lens.distortion_model == model
    assert lens.distortion[:4] == (0.1, -0.2, 0.001, 0.002)


@pytest.mark.parametrize(("text", "word"), REFUSED.values(), ids=list(REFUSED))
def test_unclear_calibration_is_refused(text: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text.replace("cam0:", "cam1:", 1) if word == "cam0" else text)
    with pytest.raises(ValueError, match=word) as refused:
        read_camera_info(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
