"""A calibrated lens and frames of another aspect, in the perception worker."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from companion.perception.messages import Begin
from companion.perception.worker import _open
from companion.settings.reading import load_settings
from vision.calibration_files.camera_info import write_camera_info
from vision.camera_model import CameraModel
from vision.sources import SourceError


@pytest.mark.parametrize(("size", "accepted"), [((320, 240), True), ((640, 360), False)])
def test_frames_of_another_aspect_ratio_end_the_source(
    tmp_path: Path, size: tuple[int, int], accepted: bool
) -> None:
    (folder := tmp_path / "images").mkdir()
    cv2.imwrite(str(folder / "0.png"), np.zeros((size[1], size[0], 3), np.uint8))
    write_camera_info(lens := tmp_path / "camera.yaml", CameraModel.from_horizontal_fov(640, 480, 1.2), "a")
    settings = load_settings(
        os.devnull,
        {
            "source.uri": str(folder),
            "source.every_frame": "true",
            "detector.enabled": "false",
            "camera.calibration_file": str(lens),
        },
        environment={},
    )
    with contextlib.ExitStack() as stack:
        source = _open(Begin(settings), stack, Mock()).source
        if accepted:
            assert (frame := source.read()) is not None
            assert (frame.width, frame.height) == size
            return
        with pytest.raises(SourceError, match=r"640x480.*640x360"):
            source.read()
