"""Depth of a camera of its own, registered to the colour camera beside it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.datasets.board_views import LENSES
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.depth_registration import DepthCalibration

PLAIN = CameraModel.from_horizontal_fov(160, 120, 1.2)


def shifted(right_m: float, colour: CameraModel = PLAIN) -> DepthCalibration:
    return DepthCalibration(PLAIN, colour, np.eye(3), np.array([right_m, 0.0, 0.0]))


def test_registered_depth_is_that_of_the_colour_camera() -> None:
    plates = [
        WorldObject(0, "car", (6.0, 0.5, 0.0), 0.4),
        WorldObject(1, "person", (4.0, -1.0, 0.0), 0.0),
        WorldObject(2, "truck", (12.0, 2.0, 0.0), 1.2),
    ]
    world = World(tuple(plates), Ground(("concrete",), 0, 256, 0.05))
    colour = LENSES["webcam"].scaled(320, 240)
    depth = CameraModel.from_horizontal_fov(400, 300, 1.4)
    beside = CameraMount(0.01, 0.06, -0.01, *np.radians((1.5, -14.0, -2.0)).tolist())
    front = CameraMount(pitch_rad=math.radians(-15.0))
    rotation = front.body_from_optical.T @ beside.body_from_optical
    position = front.body_from_optical.T @ (beside.position_frd_m - front.position_frd_m)
    level = np.eye(3)
    measured, true = (
        Renderer(world, lens, mount).render((0.0, 0.0, -1.8), level).depth_m
        for lens, mount in ((depth, beside), (colour, front))
    )
    found = DepthCalibration(depth, colour, rotation, position).register(measured, 320, 240)
    assert found.shape == (240, 320)
    assert found.dtype == np.float32
    known = np.isfinite(found) & np.isfinite(true)
    # The upper part is sky, and one side is outside the depth image.
    assert known.sum() > 0.8 * np.isfinite(true).sum()
    off = np.abs(found - true)[known] / true[known]
    # Farther away one pixel is more than 2 % of ground; the rest is at the objects' edges.
    assert (off[true[known] < 8.0] < 0.02).mean() > 0.98
    assert np.median(off) < 0.003


def test_nearest_point_of_a_pixel_is_kept_and_holes_stay() -> None:
    depth = np.full((120, 160), 4.0, np.float32)
    depth[:, 80:100] = 0.5
    depth[10:12] = np.nan
    depth[20:22] = 0.0
    found = shifted(0.05).register(depth, 160, 120)
    # Near points move right by f t / z = 11.7 px, far ones by 1.5 px.
    assert set(np.unique(found[60][np.isfinite(found[60])]).tolist()) == {0.5, 4.0}
    assert (found[60, 93:111] == 0.5).all()
    assert (found[60, 3:80] == 4.0).all()
    assert np.isnan(found[10:12]).sum() > 100
    assert np.isnan(found[21]).sum() > 100
    # What is behind the near points is hidden from the depth camera.
    assert np.isnan(found[60, 84:90]).all()


@pytest.mark.parametrize("width", [80, 160, 320, 640])
def test_larger_colour_images_have_no_gaps(width: int) -> None:
    row = (1.0 / (0.2 + np.arange(160) / 400)).astype(np.float32)
    depth = np.broadcast_to(row, (120, 160))
    found = shifted(0.03).register(depth, width, width * 3 // 4)
    inside = found[:, width // 20 : -width // 20]
    assert np.isfinite(inside).all()
    middle = found[width * 3 // 8, width // 2]
    assert middle == pytest.approx(depth[60, 80], rel=0.02)


def test_sizes_of_another_aspect_are_refused() -> None:
    with pytest.raises(ValueError, match=r"160x120.*160x90"):
        shifted(0.0).register(np.ones((90, 160), np.float32), 160, 120)
    with pytest.raises(ValueError, match=r"160x120.*320x180"):
        shifted(0.0).register(np.ones((120, 160), np.float32), 320, 180)
    assert shifted(0.0).register(np.ones((60, 80), np.float32), 320, 240).shape == (240, 320)


def test_points_beyond_the_colour_lens_do_not_fold_into_image() -> None:
    wide = CameraModel.from_horizontal_fov(320, 240, 2.4)
    barrel = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5, (-0.3, 0.0, 0.0, 0.0, 0.0))
    beyond = wide.rays(np.array([[262.0, 119.5]]))
    assert np.isnan(barrel.project(beyond)).all()  # its polynomial gives a pixel of the image
    depth = np.full((240, 320), 2.0, np.float32)
    depth[:, 240:] = 1.0
    found = DepthCalibration(wide, barrel, np.eye(3), np.zeros(3)).register(depth, 640, 480)
    assert np.unique(found[np.isfinite(found)]).tolist() == [2.0]
