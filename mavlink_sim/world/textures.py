"""Procedural ground textures, tileable, with their mip levels in one image.

Everything is periodic value noise, so that a texture repeats without a seam in both directions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Plane = NDArray[np.float32]
Colour = tuple[float, float, float]

GUTTER = 2
"""Texels repeated around every mip level, so that interpolation at its edge uses the opposite edge."""


@dataclass(frozen=True, slots=True, eq=False)
class MipAtlas:
    """A square tile and its mip levels in one image.

    Level k, `side = size / 2**k` texels wide, begins at x = 2 * side and y = GUTTER: 2 is the least factor
    with space for gutters between the levels, down to 4 texels. The space to their left is never written, so
    it takes no memory.

    Attributes:
        pixels: (size + 2 GUTTER, 3 size + GUTTER, 4) uint8, BGR and an unused channel: OpenCV 5.0 samples
        four
            channels almost three times as fast as three.
        size: texels along a side of level 0.
        levels: number of levels.
    """

    pixels: Image
    size: int
    levels: int


def mip_atlas(tile: Image) -> MipAtlas:
    """The atlas of a square tile whose side is a power of two; the last level is 4 texels wide."""
    size = tile.shape[0]
    if tile.shape != (size, size, 3) or size < 8 or size & (size - 1):
        raise ValueError(f"a tile must be square, BGR, and a power of two wide (≥ 8), got {tile.shape}")
    levels = size.bit_length() - 2
    pixels = np.zeros((size + 2 * GUTTER, 3 * size + GUTTER, 4), np.uint8)
    level = np.asarray(cv2.cvtColor(tile, cv2.COLOR_BGR2BGRA), np.uint8)
    for _ in range(levels):
        side = level.shape[0]
        padded = cv2.copyMakeBorder(level, GUTTER, GUTTER, GUTTER, GUTTER, cv2.BORDER_WRAP)
        pixels[: side + 2 * GUTTER, 2 * side - GUTTER : 3 * side + GUTTER] = padded
        level = np.asarray(cv2.resize(level, (side // 2, side // 2), interpolation=cv2.INTER_AREA), np.uint8)
    return MipAtlas(pixels, size, levels)


def value_noise(rng: np.random.Generator, size: int, cells: int, cells_y: int | None = None) -> Plane:
    """(size, size) float32 periodic smooth noise in about -1..1 with `cells` bumps across a side."""
    rows = cells_y or cells
    grid = rng.uniform(-1.0, 1.0, (rows, cells)).astype(np.float32)
    pad = 3
    padded = cv2.copyMakeBorder(grid, pad, pad, pad, pad, cv2.BORDER_WRAP)
    step_x, step_y = size / cells, size / rows
    matrix = np.array([[1 / step_x, 0, pad], [0, 1 / step_y, pad]], np.float64)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(padded, matrix, (size, size), flags=flags), np.float32)


def fractal_noise(
    rng: np.random.Generator, size: int, cells: int, octaves: int, persistence: float = 0.5
) -> Plane:
    """(size, size) float32 periodic noise of several octaves, scaled to a standard deviation of 1."""
    total = np.zeros((size, size), np.float32)
    # Wide bumps are smooth: a quarter of the size takes a sixteenth of the time and looks the same.
    coarse_size = size // 4
    coarse: Plane | None = None
    amplitude = 1.0
    for _ in range(octaves):
        if cells >= size:
            break
        if cells * 8 <= coarse_size:
            wide = amplitude * value_noise(rng, coarse_size, cells)
            coarse = wide if coarse is None else coarse + wide
        else:
            total += amplitude * value_noise(rng, size, cells)
        amplitude *= persistence
        cells *= 2
    if coarse is not None:
        padded = cv2.copyMakeBorder(coarse, 1, 1, 1, 1, cv2.BORDER_WRAP)
        grown = cv2.resize(padded, (size + 8, size + 8), interpolation=cv2.INTER_LINEAR)
        total += np.asarray(grown, np.float32)[4:-4, 4:-4]
    return total / max(float(total.std()), 1e-6)


def grain(rng: np.random.Generator, size: int) -> Plane:
    """(size, size) float32 white noise of standard deviation 1: texel to texel detail."""
    noise: Plane = rng.standard_normal((size, size), dtype=np.float32)
    return noise


def mix(weight: Plane, low: Colour, high: Colour) -> Plane:
    """(H, W, 3) float32 from colour `low` at weight 0 to `high` at weight 1 (clipped)."""
    clipped = np.clip(weight, 0.0, 1.0)
    starts, spans = np.asarray(low, np.float32), np.asarray(np.subtract(high, low), np.float32)
    # Whole planes: numpy's loops over the three channels of a pixel take five times as long.
    planes = [start + clipped * span for start, span in zip(starts, spans, strict=True)]
    return np.asarray(cv2.merge(planes), np.float32)


def shade(colours: Plane, light: Plane) -> Plane:
    """`colours` (H, W, 3) times a brightness (H, W)."""
    shaded: Plane = colours * _per_channel(light)
    return shaded


def _per_channel(plane: Plane) -> Plane:
    """A plane (H, W) once for each of the three channels: numpy broadcasts a last axis in twice the time."""
    if not plane.size:  # OpenCV merges no empty planes.
        return np.empty((*plane.shape, 3), plane.dtype)
    merged: Plane = np.asarray(cv2.merge((plane, plane, plane)))
    return merged


def _grass(rng: np.random.Generator, size: int) -> Plane:
    hue = float(rng.uniform(-1, 1))
    lush = (38 + 8 * hue, 92 + 8 * hue, 62 + 18 * hue)
    dry = (62.0, 128.0 - 8 * hue, 120.0 + 22 * hue)
    patches = fractal_noise(rng, size, 4, 5, 0.6)
    tufts = fractal_noise(rng, size, size // 16, 4, 0.8)
    colours = mix(0.42 + 0.24 * patches + 0.16 * tufts, lush, dry)
    return shade(colours, 1.0 + 0.09 * tufts + 0.10 * grain(rng, size))


def _meadow(rng: np.random.Generator, size: int) -> Plane:
    colours = _grass(rng, size)
    bloom = cv2.dilate((grain(rng, size) > 3.1).astype(np.uint8), np.ones((2, 2), np.uint8)) > 0
    bloom &= fractal_noise(rng, size, 6, 3) > 0.0
    petals = np.array([(240, 240, 240), (70, 215, 240), (190, 120, 190)], np.float32)
    colours[bloom] = petals[rng.integers(0, 3, int(bloom.sum()))]
    return colours


def _soil(rng: np.random.Generator, size: int) -> Plane:
    warm = float(rng.uniform(-1, 1))
    clods = fractal_noise(rng, size, size // 24, 4, 0.7)
    wide = fractal_noise(rng, size, 4, 4)
    colours = mix(0.5 + 0.2 * wide + 0.14 * clods, (42, 62, 84 + 10 * warm), (88, 118, 146 + 20 * warm))
    return shade(colours, 1.0 + 0.08 * clods + 0.06 * grain(rng, size))


def _rows(rng: np.random.Generator, size: int) -> Plane:
    """A field in furrows: the crop's rows run along the tile."""
    count = int(rng.integers(size // 24, size // 10))
    x = np.arange(size, dtype=np.float32)[None, :] / size
    waver = 0.25 * value_noise(rng, size, 6, 3)
    ridge = np.sin(2 * np.pi * count * x + waver * 6).astype(np.float32)
    crop = mix(0.5 + 0.3 * fractal_noise(rng, size, 6, 4), (40, 100, 70), (70, 150, 120))
    weight = np.clip(0.5 + 1.2 * ridge + 0.3 * fractal_noise(rng, size, size // 12, 2), 0, 1)[..., None]
    return np.asarray(_soil(rng, size) * (1 - weight) + crop * weight, np.float32)


def _asphalt(rng: np.random.Generator, size: int) -> Plane:
    base = float(rng.uniform(62, 118))
    wide = fractal_noise(rng, size, 4, 5, 0.6)
    level = base * (1 + 0.06 * wide + 0.07 * grain(rng, size))
    tar = np.abs(fractal_noise(rng, size, 5, 4)) < 0.012
    level[tar] *= 0.72
    return np.stack([level * 1.02, level, level * 0.98], axis=-1)


def _street(rng: np.random.Generator, size: int) -> Plane:
    """Asphalt with lanes: edge lines and a dashed line between them."""
    colours = _asphalt(rng, size)
    paint = np.array((225, 228, 228), np.float32)
    worn = np.clip(0.86 + 0.12 * fractal_noise(rng, size, size // 16, 3), 0.3, 1.0)[..., None]
    lane = size // int(rng.integers(8, 20))
    width = max(2, lane // 22)
    dash = size // int(rng.choice([8, 16]))
    marks = np.zeros((size, size), np.uint8)
    for index, left in enumerate(range(lane // 2, size - lane // 2, lane)):
        if index % 3 == 1:
            for top in range(0, size, dash):
                marks[top : top + dash // 2, left : left + width] = 1
        else:
            marks[:, left : left + width] = 1
    yellow = rng.random() < 0.2
    tint = np.array((70, 190, 225), np.float32) if yellow else paint
    painted = marks[..., None] * worn
    return np.asarray(colours * (1 - painted) + tint * painted, np.float32)


def _parking(rng: np.random.Generator, size: int) -> Plane:
    """Asphalt with parking bays: combs of short lines."""
    colours = _asphalt(rng, size)
    bay, depth = size // 32, size // 16
    line = max(2, bay // 20)
    for top in range(depth // 2, size, depth * 3):
        colours[top : top + line, :] = 215
        for left in range(0, size, bay):
            colours[top : top + depth, left : left + line] = 215
    return colours


def _concrete(rng: np.random.Generator, size: int) -> Plane:
    base = float(rng.uniform(135, 195))
    stain = fractal_noise(rng, size, 4, 6, 0.65)
    level = base * (1 + 0.06 * stain + 0.03 * grain(rng, size))
    slabs = size // int(rng.choice([4, 8, 16, 32]))
    joint = max(1, slabs // 64)
    for start in range(0, size, slabs):
        level[start : start + joint, :] *= 0.68
        level[:, start : start + joint] *= 0.68
    warm = float(rng.uniform(-0.03, 0.06))
    return np.stack([level * (1 - warm), level, level * (1 + warm)], axis=-1)


def _paving(rng: np.random.Generator, size: int) -> Plane:
    """Bricks in running bond."""
    across = int(rng.choice([64, 96, 128]))
    brick_w, brick_h = size / across, size / across / 2
    y, x = np.mgrid[0:size, 0:size].astype(np.float32)
    row = np.floor(y / brick_h)
    shifted = x / brick_w + 0.5 * (row % 2)
    column = np.floor(shifted).astype(np.int64) % across
    tone = rng.uniform(-1, 1, (2 * across + 1, across)).astype(np.float32)
    tones = tone[row.astype(np.int64) % (2 * across), column]
    joint = ((shifted % 1.0) < 0.08) | ((y / brick_h % 1.0) < 0.14)
    red = rng.random() < 0.5
    low, high = ((58, 70, 120), (92, 112, 172)) if red else ((105, 112, 118), (150, 156, 160))
    colours = mix(0.5 + 0.4 * tones, low, high)
    colours[joint] = (105, 112, 118)
    return shade(colours, 1.0 + 0.05 * grain(rng, size))


def _sand(rng: np.random.Generator, size: int) -> Plane:
    wide = fractal_noise(rng, size, 4, 4)
    y = np.arange(size, dtype=np.float32)[:, None] / size
    phase = 2 * np.pi * (size // 20) * y + 2.5 * fractal_noise(rng, size, 6, 3)
    ripples: Plane = np.sin(phase).astype(np.float32)
    colours = mix(0.5 + 0.2 * wide, (118, 160, 186), (160, 202, 224))
    return shade(colours, (1.0 + 0.035 * ripples + 0.04 * grain(rng, size)).astype(np.float32))


def _gravel(rng: np.random.Generator, size: int) -> Plane:
    stones = fractal_noise(rng, size, size // 6, 2, 0.9)
    level = float(rng.uniform(115, 165)) * (1 + 0.14 * stones + 0.10 * grain(rng, size))
    level *= 1 + 0.05 * fractal_noise(rng, size, 4, 4)
    return np.stack([level * 0.93, level * 0.98, level * 1.02], axis=-1)


def _snow(rng: np.random.Generator, size: int) -> Plane:
    drift = fractal_noise(rng, size, 6, 5)
    level = 228 + 9 * drift + 3 * grain(rng, size)
    colours = np.stack([level * 1.02, level * 0.99, level * 0.965], axis=-1)
    bare = np.clip((fractal_noise(rng, size, 8, 5) - 1.7) * 3, 0, 1)[..., None]
    return np.asarray(colours * (1 - bare) + np.array((70, 100, 110), np.float32) * bare, np.float32)


def _water(rng: np.random.Generator, size: int) -> Plane:
    swell = value_noise(rng, size, size // 40, size // 14)
    swell += 0.7 * value_noise(rng, size, size // 20, size // 8)
    wide = fractal_noise(rng, size, 3, 4)
    green = float(rng.uniform(0, 1))
    colours = mix(0.45 + 0.22 * wide, (96 - 30 * green, 74, 42), (142 - 30 * green, 118, 72))
    shaded = shade(colours, 1.0 + 0.10 * swell)
    shaded[swell > 1.12] += 34
    return shaded


def _leaves(rng: np.random.Generator, size: int) -> Plane:
    """A forest's floor: leaves and needles, strong contrast at small scale."""
    litter = fractal_noise(rng, size, size // 10, 3, 0.9)
    colours = mix(0.5 + 0.25 * litter + 0.15 * fractal_noise(rng, size, 5, 4), (28, 48, 66), (62, 112, 150))
    return shade(colours, 1.0 + 0.12 * grain(rng, size))


KINDS: dict[str, Callable[[np.random.Generator, int], Plane]] = {
    "grass": _grass,
    "meadow": _meadow,
    "soil": _soil,
    "rows": _rows,
    "asphalt": _asphalt,
    "street": _street,
    "parking": _parking,
    "concrete": _concrete,
    "paving": _paving,
    "sand": _sand,
    "gravel": _gravel,
    "snow": _snow,
    "water": _water,
    "leaves": _leaves,
}


def paint(kind: str, seed: int, size: int) -> Plane:
    """(size, size, 3) float32 BGR tile in 0..255 of a kind of ground (a key of `KINDS`)."""
    if kind not in KINDS:
        raise ValueError(f"unknown kind of ground {kind!r}; known are {', '.join(sorted(KINDS))}")
    return KINDS[kind](np.random.default_rng((seed, *kind.encode())), size)


def to_image(colours: Plane) -> Image:
    """Clip and round a float32 colour plane to uint8."""
    return np.asarray(np.clip(colours + 0.5, 0, 255), np.uint8)


def blend_by_mask(base: Plane, over: Plane, weight: Plane) -> Plane:
    """`over` on top of `base` where `weight` (H, W) is 1."""
    blended: Plane = base + (over - base) * _per_channel(weight)
    return blended


@lru_cache(maxsize=64)
def mixed_tile(kinds: tuple[str, ...], seed: int, size: int) -> MipAtlas:
    """A tile of one kind of ground with spots of the other given kinds, with its mip levels."""
    rng = np.random.default_rng((seed, 77))
    colours = paint(kinds[0], seed, size)
    for kind in kinds[1:]:
        blots = np.clip((fractal_noise(rng, size, 3, 6) - rng.uniform(0.5, 1.1)) * 9, 0, 1)
        colours = blend_by_mask(colours, paint(kind, seed + 1, size), blots)
    return mip_atlas(to_image(colours))


@lru_cache(maxsize=4)
def cloud_tile(seed: int, size: int = 256) -> Plane:
    """(size, size) float32 cloud cover, -3..3, periodic; higher is denser."""
    return fractal_noise(np.random.default_rng((seed, 991)), size, 4, 6, 0.55)


@lru_cache(maxsize=1)
def detail_tile(size: int = 512) -> Image:
    """(size, size) uint8 brightness detail around 128, one texel per centimetre, for close ground."""
    rng = np.random.default_rng(4711)
    level = 128 + 12 * fractal_noise(rng, size, 16, 5, 0.9) + 6 * grain(rng, size)
    return to_image(level.astype(np.float32))
