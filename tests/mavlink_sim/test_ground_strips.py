"""The ground is drawn in strips from an atlas of mip levels, independent of their size."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera import ground_view
from mavlink_sim.camera.renderer import Rendered, Renderer
from mavlink_sim.world.textures import GUTTER, mip_atlas
from mavlink_sim.world.world import demo_world
from vision.camera_model import CameraModel
from vision.rotation import matrix_from_euler

WORLD = demo_world(1)


def drawn(width: int, height: int, strip_rows: int, pose: tuple[float, float, float]) -> Rendered:
    """At a height above the ground, rolled and pitched."""
    height_m, roll_rad, pitch_rad = pose
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground_view, "STRIP_ROWS", strip_rows)
        renderer = Renderer(WORLD, CameraModel.from_horizontal_fov(width, height, math.radians(70.0)))
        return renderer.render((3.0, -2.0, -height_m), matrix_from_euler(roll_rad, pitch_rad, 0.7))


@settings(max_examples=40)
@given(
    size=st.sampled_from([(1, 1), (1, 65), (7, 129), (64, 2), (90, 66), (160, 128)]),
    rows=st.sampled_from([1, 7, 64]),
    pose=st.tuples(st.floats(0.2, 40.0), st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5)),
)
def test_image_is_independent_of_strips(
    size: tuple[int, int], rows: int, pose: tuple[float, float, float]
) -> None:
    """Equal except for single pixels, where the last bit of a coordinate selects another mip level."""
    width, height = size
    whole, cut = (drawn(width, height, strip_rows, pose) for strip_rows in (height, rows))
    assert cut.image.shape == (height, width, 3)
    np.testing.assert_array_equal(np.isnan(whole.depth_m), np.isnan(cut.depth_m))
    np.testing.assert_allclose(whole.depth_m, cut.depth_m, rtol=2e-3)
    off = np.abs(whole.image.astype(int) - cut.image)
    assert np.count_nonzero(off > 1) <= max(3, 0.01 * off.size)
    assert off.mean() < 0.2


def test_sky_only_image_has_no_depth() -> None:
    seen = drawn(64, 48, 16, (5.0, 0.0, 1.4))
    assert np.isnan(seen.depth_m).all()
    assert (seen.image.mean(axis=(0, 1)) > 60).all()


def test_mip_levels_have_positions_and_gutters() -> None:
    tile = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    atlas = mip_atlas(tile)
    assert (atlas.size, atlas.levels) == (32, 4)
    level = tile
    for number in range(atlas.levels):
        side = 32 >> number
        rows, columns = slice(GUTTER, GUTTER + side), slice(2 * side, 3 * side)
        np.testing.assert_array_equal(atlas.pixels[rows, columns, :3], level)
        for gutter, opposite in ((2 * side - 1, 3 * side - 1), (3 * side, 2 * side)):
            np.testing.assert_array_equal(atlas.pixels[rows, gutter], atlas.pixels[rows, opposite])
        np.testing.assert_array_equal(
            atlas.pixels[GUTTER - 1, columns], atlas.pixels[GUTTER + side - 1, columns]
        )
        half = (side // 2, side // 2)
        level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_AREA), np.uint8)
