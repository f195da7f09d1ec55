"""Calibration files in ROS's format."""

from __future__ import annotations

from pathlib import Path

import pytest

from vision.calibration_files.camera_info import read_camera_info, write_camera_info
from vision.camera_model import CameraModel
from vision.orientation import Orientation

# As ROS's camera_calibration writes it.
ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783367, 0.000000, 305.593336, 0.000000, 437.302876, 243.738352, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361976, 0.110510, 0.001014, 0.000505, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [0.999978, 0.002789, -0.006046, -0.002816, 0.999986, -0.004401, 0.006034, 0.004417, 0.999972]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.653800, 0.0, 322.797939, 0.0, 0.0, 393.653800, 241.090902, 0.0, 0.0, 0.0, 1.0, 0.0]
"""


def test_file_of_ros_is_read(tmp_path: Path) -> None:
    (file := tmp_path / "ost.yaml").write_text(ROS)
    assert read_camera_info(file).model == CameraModel(
        640,
        480,
        438.783367,
        437.302876,
        305.593336,
        243.738352,
        (-0.361976, 0.11051, 0.001014, 0.000505, 0.0),
    )


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("plumb_bob", (-0.3, 0.1, 1e-5, -2e-7, 0.01)),
        ("rational_polynomial", (0.6, 0.08, 4e-4, -3e-4, 0.002, 0.92, 0.22, 0.012)),
        ("equidistant", (-0.02, 0.004, -0.002, 3e-4)),
    ],
)
def test_written_file_is_read_unchanged(tmp_path: Path, model: str, distortion: tuple[float, ...]) -> None:
    lens = CameraModel(1920, 1080, 1100.25, 1101.5, 958.75, 541.125, distortion, model)  # type: ignore[arg-type]
    write_camera_info(file := tmp_path / "camera.yaml", lens, "front", ("24 views", "0.08 px"))
    assert read_camera_info(file).model == lens
    assert file.read_text().startswith("# 24 views\n# 0.08 px\nimage_width: 1920\n")


@pytest.mark.parametrize("orientation", [None, Orientation(), Orientation(180, True)])
def test_orientation_and_name_are_read_back(tmp_path: Path, orientation: Orientation | None) -> None:
    lens = CameraModel(640, 480, 400.0, 400.0, 320.0, 240.0, (-0.3, 0.1, 0.0, 0.0, 0.0))
    write_camera_info(file := tmp_path / "camera.yaml", lens, "front", (), orientation)
    info = read_camera_info(file)
    assert (info.model, info.name, info.orientation) == (lens, "front", orientation)
    write_camera_info(file, lens, "camera")
    assert read_camera_info(file).name is None


@pytest.mark.parametrize("keys", ["rotate_deg: 45", "rotate_deg: true", "mirror: 1"])
def test_unknown_orientation_is_refused(tmp_path: Path, keys: str) -> None:
    (file := tmp_path / "ost.yaml").write_text(f"{ROS}{keys}\n")
    with pytest.raises(ValueError, match=r"yaml.*rotate_deg"):
        read_camera_info(file)


@pytest.mark.parametrize(
    ("old", "new", "fact"),
    [
        ("image_width: 640\n", "", "_width is missing"),
        ("image_width: 640", "image_width: 640.5", "640.5"),
        ("[438.783367, ", "[", "9 numbers, got 8"),
        ("[438.783367, 0.000000", "[438.783367, 1.5", "1.5"),
        ("data: [-0.361976, 0.110510,", "data: [", "0, 4 or 5 coefficients, got 3"),
        ("plumb_bob", "thin_prism", "thin_prism"),
        ("plumb_bob", "equidistant", "4 coefficients, got 5"),
        ("-0.361976", ".nan", "distortion_coefficients"),
        (ROS, "[]", "table"),
    ],
)
def test_unusable_file_is_refused_with_its_name(tmp_path: Path, old: str, new: str, fact: str) -> None:
    assert old in ROS
    (file := tmp_path / "ost.yaml").write_text(ROS.replace(old, new, 1))
    with pytest.raises(ValueError, match="ost") as caught:
        read_camera_info(file)
    assert fact in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("source", "fits"),
    [
        ("/dev/v4l/by-id/usb-front-index0", True),
        ("/dev/v4l/by-id/usb-maker_front-index0", True),  # the same device's other name
        ("/dev/v4l/by-path/usb-1-index0", True),
        ("/dev/video2", True),
        ("2", True),
        ("/dev/v4l/by-id/usb-rear-index0", False),
        ("/dev/v4l/by-id/usb-unplugged-index0", False),
        ("/dev/v4l/by-path/usb-2-index0", False),
        ("/dev/video4", False),
        ("4", False),
        ("realsense://1", False),
        ("/dev/video9", True),  # what is not plugged in, or no device, is not known to be another camera
        ("/dev/v4l/by-path/usb-9-index0", True),
        ("csi://0", True),
        ("shm://rear", True),
        ("flight.mp4", True),
    ],
)
def test_addresses_are_compared_by_their_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, fits: bool
) -> None:
    own = "/dev/v4l/by-id/usb-front-index0"
    lens = CameraModel.from_horizontal_fov(640, 480, 1.2)
    write_camera_info(file := tmp_path / "camera.yaml", lens, own)
    info = read_camera_info(file)
    front, rear = "/dev/video2", "/dev/video4"
    nodes = {front: front, own: front, rear: rear, "/dev/v4l/by-id/usb-rear-index0": rear}
    nodes |= {"/dev/v4l/by-id/usb-maker_front-index0": front}
    nodes |= {"/dev/v4l/by-path/usb-1-index0": front, "/dev/v4l/by-path/usb-2-index0": rear}
    monkeypatch.setattr("os.path.exists", nodes.__contains__)
    monkeypatch.setattr("os.path.realpath", nodes.__getitem__)
    if fits:
        info.check_source(Orientation(), uri=source)
    else:
        with pytest.raises(ValueError, match=f"another camera.*{own}.*{source}"):
            info.check_source(Orientation(), uri=source)


def test_lens_that_folds_its_image_is_said_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folded = CameraModel(1920, 1080, 800.0, 800.0, 960.0, 540.0, (0.1, -0.2, 0.0, 0.0), "equidistant")
    write_camera_info(file := tmp_path / "folded.yaml", folded, "camera")
    write_camera_info(whole := tmp_path / "whole.yaml", CameraModel(640, 480, 500, 500, 320, 240), "camera")
    (ros := tmp_path / "ost.yaml").write_text(ROS)
    for each in (file, file, whole, ros):
        read_camera_info(each)
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert f"{file}: " in record.getMessage()
    assert "730 px" in record.getMessage()
    assert "1101 px" in record.getMessage()
