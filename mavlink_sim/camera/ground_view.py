"""Rendering of ground and sky, with the depth of the ground.

Over level ground the reciprocal of the depth is linear in the pixel: 1/depth = (a·u + b·v + c) / height, and
the visible point is eye + depth · ray. So every pixel's texel comes from a few passes over arrays, over one
strip of the image at a time, so that the data stay in the processor's cache. The mip level follows from the
area of a pixel's footprint on the ground.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.world.textures import (
    GUTTER,
    Image,
    MipAtlas,
    Plane,
    blend_by_mask,
    cloud_tile,
    detail_tile,
    fractal_noise,
    mip_atlas,
    mixed_tile,
    paint,
    to_image,
)
from mavlink_sim.world.world import Ground, Light, Patch, Sky, World

Matrix = NDArray[np.float64]

NEAREST_INVERSE = 1e-4
"""Reciprocal depth of the horizon: 10 km."""
DETAIL_REACH_M = 6.0
DITHER = 0.5
STRIP_ROWS = 64
"""With 640 columns a strip needs 1.5 MB; no number of rows from 32 to 96 was faster."""
HAZE_FROM = 0.03
"""Share of the visibility up to which haze is not drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One camera pose.

    Attributes:
        eye: (3,) NED metres; z negative above the ground.
        ned_from_pixel: (3, 3) takes (u, v, 1) to the ray with depth 1 along the optical axis, in NED.
        pixel_from_ned: (3, 3) its inverse: takes an offset from the eye to depth · (u, v, 1).
        focal_px: mean focal length.
        width, height: of the image.
    """

    eye: Matrix
    ned_from_pixel: Matrix
    pixel_from_ned: Matrix
    focal_px: float
    width: int
    height: int


class Strip:
    """Some rows of the image, with scratch arrays for them: the same memory for every strip.

    Attributes:
        where: the rows.
        columns, rows: (h, W) float32, each pixel's column, and its row counted from the strip's first.
        dither: (h, W) float32, factors of the pixels' footprints.
        depth, map_x, map_y, work, scale, weight: (h, W) float32. level: (h, W) int32. flat: (h, W, 3) uint8.
    """

    def __init__(self, buffers: Buffers, where: slice) -> None:
        height = where.stop - where.start
        self.where = where
        self.columns, self.rows = buffers.columns[:height], buffers.rows[:height]
        self.dither = buffers.dither[where]
        planes = buffers.planes[:, :height]
        self.depth, self.map_x, self.map_y, self.work, self.scale, self.weight = planes[:6]
        self.level = planes[6].view(np.int32)
        self.flat = buffers.flat[:height]


class Buffers:
    """Scratch arrays for one image size, so that frames need not allocate them."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        strip = (min(STRIP_ROWS, height), width)
        self.rows, self.columns = np.indices(strip, np.float32)
        rng = np.random.default_rng(3)
        # Half an octave of fixed dither hides the lines at which the mip level changes.
        self.dither = np.exp2(rng.uniform(-DITHER, DITHER, (height, width))).astype(np.float32)
        self.planes = np.empty((7, *strip), np.float32)
        self.flat = np.empty((*strip, 3), np.uint8)

    def strips(self) -> Iterator[Strip]:
        """The whole image, from the top."""
        most = len(self.rows)
        for top in range(0, self.height, most):
            yield Strip(self, slice(top, min(top + most, self.height)))

    def part(self, strip: Strip, rows: slice) -> Strip:
        """Some rows of a strip, counted from its first; scratch arrays are not copied."""
        return Strip(self, slice(strip.where.start + rows.start, strip.where.start + rows.stop))


def ground_atlas(ground: Ground) -> MipAtlas:
    """The ground's tile, with its patches, road and pad painted in."""
    if not (ground.patches or ground.pad or ground.road_east_m is not None):
        return mixed_tile(ground.kinds, ground.seed, ground.tile_texels)
    return _painted_tile(replace(ground, gain=(1.0, 1.0, 1.0)))


@lru_cache(maxsize=16)
def _painted_tile(ground: Ground) -> MipAtlas:
    size, texel = ground.tile_texels, ground.texel_m
    rng = np.random.default_rng((ground.seed, 8))
    colours = paint(ground.kinds[0], ground.seed, size)
    rough = fractal_noise(rng, size, 12, 5, 0.6)
    for kind in ground.kinds[1:]:
        weight = np.clip((fractal_noise(rng, size, 3, 6) - 0.6) * 2.5, 0, 1)
        colours = blend_by_mask(colours, paint(kind, ground.seed + 1, size), weight)
    period = size * texel
    axis = (np.arange(size, dtype=np.float32) + 0.5) * texel
    north = (axis[:, None] + ground.origin_m[0] + period / 2) % period - period / 2
    east = (axis[None, :] + ground.origin_m[1] + period / 2) % period - period / 2
    for patch in ground.patches:
        _paint_patch(colours, patch, ground, north[:, 0], east[0], rough)
    if ground.road_east_m is not None:
        _paint_road(colours, ground, ground.road_east_m, north, east[0], rough)
    if ground.pad:
        _paint_pad(colours, north[:, 0], east[0])
    return mip_atlas(to_image(colours))


LOCAL_TEXELS = 512


def _colour(*channels: float) -> Plane:
    return np.array(channels, np.float32)


def _local(kind: str, seed: int, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Plane:
    """A kind of ground for some rows and columns of the tile, from a small repeated tile."""
    small = _local_tile(kind, seed)
    repeated: Plane = small[np.ix_(rows % LOCAL_TEXELS, columns % LOCAL_TEXELS)]
    return repeated


@lru_cache(maxsize=8)
def _local_tile(kind: str, seed: int) -> Plane:
    return paint(kind, seed, LOCAL_TEXELS)


def _paint_patch(
    colours: Plane, patch: Patch, ground: Ground, north: Plane, east: Plane, rough: Plane
) -> None:
    """Paint a round spot into the tile, in place; it may run over the tile's edge."""
    half = ground.tile_texels * ground.texel_m / 2
    north_off = (north - patch.north_m + half) % (2 * half) - half
    east_off = (east - patch.east_m + half) % (2 * half) - half
    reach = patch.radius_m + 2.0
    rows, columns = np.flatnonzero(np.abs(north_off) < reach), np.flatnonzero(np.abs(east_off) < reach)
    where = np.ix_(rows, columns)
    away = np.hypot(north_off[rows][:, None], east_off[columns][None, :])
    weight = np.clip((patch.radius_m - away) * 1.6 + 0.5 * rough[where], 0, 1).astype(np.float32)
    colours[where] = blend_by_mask(colours[where], _local(patch.kind, ground.seed + 2, rows, columns), weight)


def _paint_road(
    colours: Plane, ground: Ground, road_east_m: float, north: Plane, east: Plane, rough: Plane
) -> None:
    """Paint the winding road into the tile, in place: gravel verge, asphalt, edge lines, dashes."""
    period = ground.tile_texels * ground.texel_m
    swing = 5.0 * math.copysign(1.0, road_east_m)
    from_middle = (east - road_east_m + period / 2) % period - period / 2
    columns = np.flatnonzero(np.abs(from_middle) < 11.0)
    rows = np.arange(ground.tile_texels)
    where = np.ix_(rows, columns)
    beside = np.abs(from_middle[columns][None, :] - swing * np.sin(2 * math.pi / period * north))
    uneven = rough[where]
    part = colours[where]
    verge = np.clip((4.1 - beside) * 1.3 + 0.35 * uneven, 0, 1).astype(np.float32)
    part = blend_by_mask(part, _local("gravel", ground.seed + 3, rows, columns), verge)
    road = np.clip((3.2 - beside) * 6 + 0.5, 0, 1).astype(np.float32)
    part = blend_by_mask(part, _local("asphalt", ground.seed + 4, rows, columns), road)
    soft = 1.0 / ground.texel_m
    edge = np.clip(0.5 + (0.075 - np.abs(beside - 2.9)) * soft, 0, 1)
    dashes = (north % (period / 26)) < period / 56
    centre = np.clip(0.5 + (0.075 - beside) * soft, 0, 1) * dashes
    worn = np.clip(0.85 + 0.1 * uneven, 0.3, 1)
    marks = (np.maximum(edge, centre) * worn).astype(np.float32)
    colours[where] = blend_by_mask(part, _colour(226, 230, 230), marks)


def _paint_pad(colours: Plane, north: Plane, east: Plane) -> None:
    """Paint a round concrete pad of 2.2 m radius with a white ring and an H into the tile, in place."""
    rows, columns = np.flatnonzero(np.abs(north) < 2.2), np.flatnonzero(np.abs(east) < 2.2)
    where = np.ix_(rows, columns)
    north, east = north[rows][:, None], east[columns][None, :]
    away = np.hypot(north, east)
    pad = np.clip((2.2 - away) * 12, 0, 1).astype(np.float32)
    part = blend_by_mask(colours[where], _colour(150, 152, 152), pad)
    ring = np.abs(away - 1.85) < 0.14
    bars = (np.abs(np.abs(east) - 0.5) < 0.13) & (np.abs(north) < 0.85)
    cross = (np.abs(north) < 0.13) & (np.abs(east) < 0.5)
    marks = (ring | bars | cross).astype(np.float32)
    colours[where] = blend_by_mask(part, _colour(236, 238, 238), marks)


def draw_ground(world: World, view: View, buffers: Buffers, inverse_depth: Plane) -> Image:
    """(H, W, 3) ground without haze; undefined in the sky. Fills `inverse_depth` (0 = sky)."""
    image = np.empty((view.height, view.width, 3), np.uint8)
    ground, atlas = world.ground, ground_atlas(world.ground)
    # 1/depth of the ground, negative above the horizon.
    reciprocal = view.ned_from_pixel[2] / _height_m(view)
    for strip in buffers.strips():
        inverse = inverse_depth[strip.where]
        _linear(reciprocal, strip, inverse)
        # It is linear, so the corners decide whether there is any ground.
        if inverse[:: len(inverse) - 1 or 1, :: view.width - 1 or 1].max() > NEAREST_INVERSE:
            _draw_strip(ground, atlas, view, buffers, strip, inverse, image[strip.where])
        cv2.threshold(inverse, NEAREST_INVERSE, 0.0, cv2.THRESH_TOZERO, dst=inverse)
    return image


def _height_m(view: View) -> float:
    return max(float(-view.eye[2]), 1e-3)


def _draw_strip(
    ground: Ground,
    atlas: MipAtlas,
    view: View,
    buffers: Buffers,
    strip: Strip,
    inverse_depth: Plane,
    image: Image,
) -> None:
    """Draw a strip with ground into `image`."""
    height_m = _height_m(view)
    down = view.ned_from_pixel[2]
    depth = strip.depth
    np.maximum(inverse_depth, NEAREST_INVERSE, out=strip.work)
    np.divide(1.0, strip.work, out=depth)

    period = atlas.size * ground.texel_m
    c, s = math.cos(ground.yaw_rad) / period, math.sin(ground.yaw_rad) / period
    north, east = view.ned_from_pixel[0], view.ned_from_pixel[1]
    eye_n, eye_e = view.eye[0] - ground.origin_m[0], view.eye[1] - ground.origin_m[1]
    map_x, map_y, work, scale = strip.map_x, strip.map_y, strip.work, strip.scale
    _fraction(c * east - s * north, c * eye_e - s * eye_n, strip, map_x)
    _fraction(c * north + s * east, c * eye_n + s * eye_e, strip, map_y)

    # Mean footprint squared, in texels: across d/f, along d/f · (1 + slope · d).
    slope = math.hypot(float(down[0]), float(down[1])) * view.focal_px / height_m
    per_texel = 0.8 / (view.focal_px * ground.texel_m) ** 2
    np.multiply(depth, np.float32(per_texel * slope), out=work)
    work += np.float32(per_texel)
    work *= depth
    work *= depth
    work *= strip.dither
    # The exponent of a float is its logarithm to base 2; half of it, as the area is squared length.
    level = strip.level
    np.subtract(work.view(np.int32), 127 << 23, out=level)
    np.right_shift(level, 24, out=level)
    np.clip(level, 0, atlas.levels - 1, out=level)
    # And back: the level's side, a power of two.
    np.subtract(126 + atlas.size.bit_length(), level, out=level)
    np.left_shift(level, 23, out=scale.view(np.int32))
    map_x += 2.0
    map_x *= scale
    map_x -= 0.5
    map_y *= scale
    map_y += np.float32(GUTTER - 0.5)
    found = cv2.remap(atlas.pixels, map_x, map_y, cv2.INTER_LINEAR)
    cv2.cvtColor(found, cv2.COLOR_BGRA2BGR, dst=image)
    _add_detail(view, height_m, buffers, strip, image)
    if ground.gain != (1.0, 1.0, 1.0):
        steps = np.arange(256, dtype=np.float32)[:, None] * _colour(*ground.gain)
        cv2.LUT(image, np.clip(steps, 0, 255).astype(np.uint8)[None], dst=image)


def _linear(row: Matrix, strip: Strip, out: Plane) -> None:
    """out[v, u] = row · (u, v, 1)."""
    start = float(row[1]) * strip.where.start + float(row[2])
    cv2.addWeighted(strip.columns, float(row[0]), strip.rows, float(row[1]), start, dst=out)


def _fraction(row: Matrix, start: float, strip: Strip, out: Plane) -> None:
    """The fractional part of start + depth · (row · pixel): the ground point's position in the tile, 0..1."""
    _linear(row, strip, out)
    out *= strip.depth
    out += np.float32(start - math.floor(start))
    np.floor(out, out=strip.work)
    out -= strip.work


def _add_detail(view: View, height_m: float, buffers: Buffers, strip: Strip, image: Image) -> None:
    """Fine structure on close ground, where the tile's texels are larger than pixels."""
    if height_m > DETAIL_REACH_M:
        return
    near = np.flatnonzero(strip.depth.min(axis=1) < DETAIL_REACH_M)
    if not len(near):
        return
    rows = slice(int(near[0]), int(near[-1]) + 1)
    depth, image = strip.depth[rows], image[rows]
    strip = buffers.part(strip, rows)
    tile = detail_tile()
    side = tile.shape[0]
    map_x, map_y, work = strip.map_x, strip.map_y, strip.work
    for axis, out in ((0, map_y), (1, map_x)):
        row = view.ned_from_pixel[axis] * (100.0 / side)
        _linear(row, strip, out)
        out *= depth
        out += np.float32((view.eye[axis] * 100.0 / side) % 1.0)
        np.floor(out, out=work)
        out -= work
        out *= np.float32(side)
    detail = cv2.remap(tile, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    # Fades out towards the reach: beyond it the detail is finer than a pixel.
    share = np.clip(1.4 - depth * np.float32(1.4 / DETAIL_REACH_M), 0.0, 1.0, out=work)
    rest = np.subtract(1.0, share, out=strip.weight)
    faded = cv2.blendLinear(detail, np.full_like(detail, 128), share, rest)
    cv2.multiply(image, cv2.cvtColor(faded, cv2.COLOR_GRAY2BGR), dst=image, scale=1 / 128)


def draw_sky(sky: Sky, light: Light, view: View, inverse_depth: Plane, image: Image) -> None:
    """Paint the sky where `inverse_depth` is 0, computed at a quarter of the size: it is soft."""
    empty = np.asarray(inverse_depth <= 0.0, np.uint8)
    rows = np.flatnonzero(empty.any(axis=1))
    if not len(rows):
        return
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    small_h, small_w = max(2, (bottom - top) // 4 + 1), max(2, view.width // 4)
    u = np.linspace(0, view.width - 1, small_w, dtype=np.float32)[None, :]
    v = np.linspace(top, bottom - 1, small_h, dtype=np.float32)[:, None]
    rays = [(row[0] * u + (row[1] * v + row[2])).astype(np.float32) for row in view.ned_from_pixel]
    length = np.sqrt(rays[0] ** 2 + rays[1] ** 2 + rays[2] ** 2)
    rise = np.maximum(-rays[2] / length, 0.004)
    blend = 1.0 - np.exp(-rise * 4.5)
    colours = _colour(*sky.horizon) + blend[..., None] * (_colour(*sky.zenith) - _colour(*sky.horizon))
    sun = light.towards_sun_ned
    towards = (rays[0] * sun[0] + rays[1] * sun[1] + rays[2] * sun[2]) / length
    glow = np.exp((np.clip(towards, -1, 1) - 1) * 14) * 55 + np.exp((np.clip(towards, -1, 1) - 1) * 900) * 160
    colours += glow[..., None] * _colour(0.75, 0.92, 1.0)
    if sky.clouds > 0.0:
        tile = cloud_tile(sky.seed)
        side = tile.shape[0]
        reach = side * 0.11 / (rise * length)
        x = (rays[1] * reach + side * 64) % side
        y = (rays[0] * reach + side * 64) % side
        x, y = x.astype(np.float32), y.astype(np.float32)
        cover = cv2.remap(tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        dense = np.clip((cover - 1.6 + 2.6 * sky.clouds) * 0.75, 0, 1) * np.clip(rise * 7 - 0.25, 0, 1)
        dense *= 0.9
        tone = 244 - 26 * np.clip(cover - 0.4, 0, 2)
        colours += (tone[..., None] * _colour(1.0, 0.99, 0.975) - colours) * dense[..., None]
    # The first and last small rows lie on the first and last rows of the band.
    stretched = cv2.resize(to_image(colours), (view.width, bottom - top), interpolation=cv2.INTER_LINEAR)
    cv2.copyTo(stretched, empty[top:bottom], image[top:bottom])


def add_haze(sky: Sky, inverse_depth: Plane, buffers: Buffers, image: Image) -> None:
    """Fade everything into the horizon's colour with distance, in place. Paint the sky afterwards."""
    # OpenCV fills an image with a colour thirty times as fast as an assignment does.
    blue, green, red = (int(min(max(channel, 0.0), 255.0)) for channel in sky.horizon)
    cv2.rectangle(buffers.flat, (0, 0, buffers.width, STRIP_ROWS), (blue, green, red), cv2.FILLED)
    clear = 1.0 / (HAZE_FROM * sky.visibility_m)
    for strip in buffers.strips():
        hazy = np.flatnonzero(inverse_depth[strip.where].min(axis=1) < clear)
        if not len(hazy):
            continue
        part = buffers.part(strip, slice(int(hazy[0]), int(hazy[-1]) + 1))
        share = np.maximum(inverse_depth[part.where], NEAREST_INVERSE, out=part.weight)
        np.divide(np.float32(-1.0 / sky.visibility_m), share, out=share)
        cv2.exp(share, dst=share)
        rest = np.subtract(1.0, share, out=part.work)
        pixels = image[part.where]
        cv2.blendLinear(pixels, part.flat, share, rest, dst=pixels)
