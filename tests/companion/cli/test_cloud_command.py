"""`companion detect --cloud`: files, view, JSON, and one line for bad input."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from mavlink_sim.camera.depth_camera import DepthSensor, measured_depth
from mavlink_sim.camera.renderer import DEFAULT_CAMERA, DEFAULT_MOUNT, Renderer
from mavlink_sim.camera.scene_file import load_scene
from vision.camera_model import CameraCalibration, CameraMount
from vision.frame import Frame
from vision.point_cloud import cloud_from_depth, read_cloud, voxel_grid
from vision.rotation import matrix_from_euler
from vision.shared_frame import SharedFrameWriter

NAME = f"cloud_command_{os.getpid()}"
URI = f"shm://{NAME}"


@pytest.fixture(scope="module")
def frame() -> Frame:
    """The obstacle course from its start, 3 m high: two walls 10 m ahead and a pole."""
    rendered = Renderer(load_scene("obstacle_course").world_at(0.0)).render((0.0, 0.0, -3.0), np.eye(3))
    true_m = np.asarray(rendered.depth_m, np.float32)
    depth_m = measured_depth(true_m, DEFAULT_CAMERA.fx, DepthSensor(), np.random.default_rng(8))
    return Frame(np.ascontiguousarray(rendered.image), 1, 0, depth_m)


@contextmanager
def shared(frame: Frame, mount: CameraMount = DEFAULT_MOUNT) -> Iterator[None]:
    calibration = CameraCalibration(DEFAULT_CAMERA, mount)
    depth = frame.depth_m is not None
    with SharedFrameWriter(NAME, frame.width, frame.height, depth, calibration=calibration) as writer:
        writer.write(replace(frame, captured_ns=time.monotonic_ns()))
        yield


def run(source: str | Path, output: Path, *options: str | Path) -> Any:
    words = ["detect", source, "--model", "none", "--cloud", output, *options]
    return CliRunner().invoke(app, list(map(str, words)))


def refused(source: str | Path, output: Path, *options: str | Path) -> str:
    result = run(source, output, *options)
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    assert line.startswith("companion: ")
    return str(line)


def test_the_file_has_all_pixels_in_the_body_frame(frame: Frame, tmp_path: Path) -> None:
    with shared(frame):
        result = run(URI, tmp_path / "all.ply", "--max-range", "12")
    assert result.exit_code == 0, result.output
    cloud = read_cloud(tmp_path / "all.ply")
    assert frame.depth_m is not None
    expected = cloud_from_depth(
        frame.depth_m,
        DEFAULT_CAMERA,
        image=frame.image,
        frame="body",
        mount=DEFAULT_MOUNT,
        range_m=(0.0, 12.0),
    )
    np.testing.assert_allclose(cloud.points, expected.points, atol=1e-4)
    np.testing.assert_array_equal(cloud.colours, expected.colours)
    assert cloud.frame == "body"
    assert cloud.stamp_ns > 0
    assert f"{len(expected)} points" in result.stdout


def test_frame_and_attitude_turn_the_points(frame: Frame, tmp_path: Path) -> None:
    with shared(frame):
        common = ("--voxel", "0.2", "--cloud-text")
        assert run(URI, tmp_path / "camera.pcd", "--cloud-frame", "camera", *common).exit_code == 0
        assert (
            run(
                URI, tmp_path / "ned.pcd", "--cloud-frame", "ned", "--attitude", "0", "-10", "90", *common
            ).exit_code
            == 0
        )
    camera, ned = read_cloud(tmp_path / "camera.pcd"), read_cloud(tmp_path / "ned.pcd")
    assert (camera.frame, ned.frame) == ("camera", "ned")
    attitude = matrix_from_euler(0.0, math.radians(-10.0), math.radians(90.0))
    expected = camera.in_body(DEFAULT_MOUNT).in_ned(attitude).points
    # The grids differ, the surfaces do not.
    np.testing.assert_allclose(ned.points.mean(axis=0), expected.mean(axis=0), atol=0.3)
    assert ned.points[:, 1].min() > 0.5  # all are east
    np.testing.assert_array_equal(voxel_grid(ned, 0.2).points, ned.points)


def test_clusters_are_the_walls_and_the_pole(frame: Frame, tmp_path: Path) -> None:
    view = tmp_path / "cloud.png"
    with shared(frame):
        result = run(URI, tmp_path / "cloud.ply", "--clusters", "--json", "--cloud-view", view)
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    report = json.loads(result.stdout)
    assert set(report) == {"sequence", "captured_ns", "width", "height", "cloud"}
    report = report["cloud"]
    assert set(report) == {"file", "frame", "points", "clusters"}
    assert report["frame"] == "body"
    assert report["points"] == len(read_cloud(tmp_path / "cloud.ply"))
    left, right, *others = sorted(report["clusters"], key=lambda each: -each["points"])
    assert set(left) == {"points", "range_m", "centre_m", "size_m", "axes", "low_m", "high_m"}
    for wall in (left, right):
        assert wall["centre_m"][0] == pytest.approx(10.0, abs=0.5)
        assert wall["size_m"][2] == pytest.approx(3.0, abs=0.4)  # upright
        assert wall["range_m"] == pytest.approx(math.hypot(*wall["centre_m"][:2]), abs=0.01)
    assert any(each["range_m"] == pytest.approx(8.0, abs=0.3) and each["size_m"][0] < 0.6 for each in others)
    drawn = cv2.imread(str(view))
    assert drawn is not None
    assert drawn.shape == (540, 960, 3)
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 500


@pytest.mark.parametrize("pitch_deg", ["35", "50"])
def test_ground_that_is_not_level_is_warned_about(
    frame: Frame, tmp_path: Path, pitch_deg: str, caplog: pytest.LogCaptureFixture
) -> None:
    """As of a camera whose tilt is not set."""
    with shared(frame):
        result = run(URI, tmp_path / "cloud.ply", "--clusters", "--attitude", "0", pitch_deg, "0")
    assert result.exit_code == 0, result.output
    (record,) = caplog.records
    assert "--attitude" in record.getMessage()


def test_depth_of_a_second_source_is_used(frame: Frame, tmp_path: Path) -> None:
    depth_mm = np.full((frame.height, frame.width), 4000, np.uint16)
    for name, array in (("image", frame.image), ("depth", depth_mm)):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "000.png"), array)
    depth = ("--source-depth", tmp_path / "depth")
    result = run(
        tmp_path / "image", tmp_path / "a.ply", *depth, "--camera-mount-pitch-deg", "-90", "--max-range", "5"
    )
    assert result.exit_code == 0, result.output
    cloud = read_cloud(tmp_path / "a.ply")
    assert len(cloud) == frame.height * frame.width
    np.testing.assert_allclose(cloud.points[:, 2], 4.0, atol=1e-3)  # it looks down


def test_a_frame_without_depth_is_one_line(frame: Frame, tmp_path: Path) -> None:
    with shared(replace(frame, depth_m=None)):
        assert "depth" in refused(URI, tmp_path / "a.ply")
    image = tmp_path / "image.png"
    cv2.imwrite(str(image), frame.image)
    assert "depth" in refused(image, tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()


def test_an_empty_cloud_is_one_line(frame: Frame, tmp_path: Path) -> None:
    nothing = np.full((frame.height, frame.width), np.nan, np.float32)
    with shared(replace(frame, depth_m=nothing)):
        assert "empty" in refused(URI, tmp_path / "a.ply")
    with shared(frame):
        assert "0.2 m" in refused(URI, tmp_path / "a.ply", "--max-range", "0.2")
    assert not (tmp_path / "a.ply").exists()


def test_other_bad_input_is_one_line(frame: Frame, tmp_path: Path) -> None:
    output = tmp_path / "a.ply"
    with shared(frame):
        assert "a.las" in refused(URI, tmp_path / "a.las")
        assert "a.gif" in refused(URI, output, "--cloud-view", tmp_path / "a.gif")
        assert "--attitude" in refused(URI, output, "--attitude", "0", "nan", "0")
        missing = tmp_path / "missing" / "a.ply"
        line = refused(URI, missing)
        assert f"write {missing}: " in line
        assert "such folder" in line
        assert "missing" in refused(URI, output, "--cloud-view", tmp_path / "missing" / "a.png")
        assert "horizontal_fov_deg" in refused(URI, output, "--camera-horizontal-fov-deg", "-1")
    with shared(frame, replace(DEFAULT_MOUNT, on_gimbal=True)):
        assert "gimbal" in refused(URI, output, "--cloud-frame", "body")
        assert run(URI, output, "--cloud-frame", "camera").exit_code == 0
