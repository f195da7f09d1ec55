"""Distractors: objects of no class of the detector."""

from __future__ import annotations

import math

import numpy as np

from mavlink_sim.world.solids import Body, between, inset, rectangle


def tree(rng: np.random.Generator) -> Body:
    """A broad-leaved tree or a conifer, 3 to 7 m tall."""
    body = Body()
    tall = between(rng, 3.2, 7.0)
    if rng.random() < 0.4:
        body.tube((0, 0, 0), (0, 0, tall * 0.3), 0.16, "bark", 6)
        for low, high, radius in ((0.14, 0.5, 0.25), (0.36, 0.75, 0.19), (0.6, 1.0, 0.12)):
            body.tube((0, 0, tall * low), (0, 0, tall * high), tall * radius, "needles", 8, 0.03)
        return body
    body.tube((0, 0, 0), (0, 0, tall * 0.55), 0.17, "bark", 6, 0.1)
    for _ in range(int(rng.integers(3, 6))):
        radius = tall * between(rng, 0.16, 0.25)
        centre = (
            between(rng, -0.16, 0.16) * tall,
            between(rng, -0.16, 0.16) * tall,
            tall * between(rng, 0.55, 0.8),
        )
        body.ellipsoid(centre, (radius, radius, radius * 0.8), "leaves", 7, 4, rng, 0.16, 0.16)
    return body


def bush(rng: np.random.Generator) -> Body:
    """One to three leafy humps, up to 1.5 m."""
    body = Body()
    for _ in range(int(rng.integers(1, 4))):
        radius = between(rng, 0.35, 0.9)
        centre = (between(rng, -0.6, 0.6), between(rng, -0.6, 0.6), radius * 0.55)
        body.ellipsoid(centre, (radius, radius, radius * 0.8), "leaves", 7, 4, rng, 0.18, 0.18)
    return body


def rock(rng: np.random.Generator) -> Body:
    """An uneven boulder."""
    body = Body()
    radius = between(rng, 0.2, 1.0)
    radii = (radius * between(rng, 0.8, 1.5), radius, radius * between(rng, 0.5, 0.9))
    body.ellipsoid((0, 0, radii[2] * 0.45), radii, "stone", 7, 4, rng, 0.2, 0.1)
    return body


def pole(rng: np.random.Generator) -> Body:
    """A lamp post, a sign or a bare pole."""
    body = Body()
    tall = between(rng, 2.0, 6.0)
    body.tube((0, 0, 0), (0, 0, tall), 0.06, "metal", 6, 0.045)
    kind = rng.random()
    if kind < 0.4:
        body.box((0.4, 0, tall), (0.9, 0.08, 0.06), "metal")
        body.box((0.75, 0, tall - 0.03), (0.35, 0.2, 0.1), "lamp")
    elif kind < 0.75:
        size = between(rng, 0.4, 0.9)
        body.box((0.07, 0, tall - size / 2), (0.03, size, size), "sign")
    return body


def crate(rng: np.random.Generator) -> Body:
    """A box, a stack of boxes or a pallet."""
    body = Body()
    size = (between(rng, 0.5, 1.6), between(rng, 0.5, 1.4), between(rng, 0.3, 1.3))
    body.box((0, 0, size[2] / 2), size, "wood", top_slot="lid")
    if rng.random() < 0.4:
        small = between(rng, 0.3, 0.5)
        body.box((between(rng, -0.2, 0.2), 0, size[2] + small / 2), (small, small, small), "wood", 0.4, "lid")
    return body


def barrel(rng: np.random.Generator) -> Body:
    """A drum, a cone or a bollard."""
    body = Body()
    if rng.random() < 0.5:
        radius, tall = between(rng, 0.25, 0.4), between(rng, 0.7, 1.1)
        body.tube((0, 0, 0), (0, 0, tall), radius, "drum", 10, cap_slot="lid")
    else:
        body.box((0, 0, 0.02), (0.4, 0.4, 0.04), "drum")
        body.tube((0, 0, 0.04), (0, 0, 0.35), 0.16, "drum", 8, 0.1)
        body.tube((0, 0, 0.35), (0, 0, 0.55), 0.1, "lid", 8, 0.065)
        body.tube((0, 0, 0.55), (0, 0, 0.72), 0.065, "drum", 8, 0.03)
    return body


def shed(rng: np.random.Generator) -> Body:
    """A hut with a pitched roof, a door and a window, or a sea container."""
    body = Body()
    if rng.random() < 0.4:
        length = between(rng, 3.0, 6.1)
        body.box((0, 0, 1.3), (length, 2.4, 2.6), "wall", top_slot="wall")
        for side in (-1.0, 1.0):
            for x in np.arange(-length / 2 + 0.4, length / 2, 0.6):
                rib = [
                    (x, side * 1.2, 0.1),
                    (x + 0.12, side * 1.2, 0.1),
                    (x + 0.12, side * 1.2, 2.5),
                    (x, side * 1.2, 2.5),
                ]
                body.add_decal(np.array(rib), "dark", (0, side, 0))
        return body
    length, width, wall = between(rng, 2.5, 6.0), between(rng, 2.2, 4.5), between(rng, 2.1, 2.6)
    ridge = wall + width * 0.33
    sides = body.loft(rectangle(length, width), rectangle(length, width), 0, wall, "wall")
    body.add_decal(inset(sides[0], 0.15, 0.15 + 0.9 / length, 0.0, 0.85), "dark", (0, -1, 0))
    body.add_decal(inset(sides[2], 0.5, 0.5 + 0.9 / length, 0.4, 0.8), "dark", (0, 1, 0))
    profile = np.array([(-width / 2 - 0.25, wall), (width / 2 + 0.25, wall), (0.0, ridge)])
    half = length / 2 + 0.2
    ends = [np.column_stack([np.full(3, x), profile]) for x in (-half, half)]
    slopes = [np.array([ends[0][i], ends[0][j], ends[1][j], ends[1][i]]) for i, j in ((0, 1), (1, 2), (2, 0))]
    body.add_solid([*ends, *slopes], ["wall", "wall", "roof", "roof", "roof"])
    return body


def fence(rng: np.random.Generator) -> Body:
    """Posts with rails, or a low wall."""
    body = Body()
    length = between(rng, 2.5, 7.0)
    if rng.random() < 0.4:
        body.box((0, 0, 0.4), (length, 0.3, 0.8), "stone")
        return body
    for x in np.linspace(-length / 2, length / 2, max(2, round(length / 1.4))):
        body.box((float(x), 0, 0.55), (0.1, 0.1, 1.1), "wood")
    for z in (0.4, 0.85):
        body.box((0, 0.06, z), (length, 0.03, 0.12), "wood")
    return body


def table(rng: np.random.Generator) -> Body:
    """A table or a bench without a back."""
    body = Body()
    length, width, top = between(rng, 0.9, 1.9), between(rng, 0.4, 0.9), between(rng, 0.42, 0.76)
    body.box((0, 0, top), (length, width, 0.05), "wood")
    for x in (-length / 2 + 0.08, length / 2 - 0.08):
        for y in (-width / 2 + 0.06, width / 2 - 0.06):
            body.box((x, y, top / 2), (0.06, 0.06, top), "wood")
    return body


def bale(rng: np.random.Generator) -> Body:
    """A round bale of hay, or logs."""
    body = Body()
    if rng.random() < 0.5:
        radius = between(rng, 0.5, 0.75)
        body.tube((-0.6, 0, radius), (0.6, 0, radius), radius, "hay", 10, cap_slot="lid")
        return body
    length = between(rng, 1.5, 4.0)
    for y, z in ((-0.26, 0.16), (0.06, 0.16), (-0.1, 0.42))[: int(rng.integers(1, 4))]:
        body.tube((-length / 2, y, z), (length / 2, y, z), 0.16, "bark", 7, cap_slot="lid")
    return body


def tarpaulin(rng: np.random.Generator) -> Body:
    """A coloured sheet over a low object, or a solar panel on feet."""
    body = Body()
    length, width = between(rng, 1.2, 3.5), between(rng, 1.0, 2.0)
    if rng.random() < 0.5:
        tilt = between(rng, 0.15, 0.5)
        drop = math.sin(tilt) * width / 2
        corners = np.array(
            [
                (-length / 2, -width / 2, 0.7 + drop),
                (length / 2, -width / 2, 0.7 + drop),
                (length / 2, width / 2, 0.7 - drop),
                (-length / 2, width / 2, 0.7 - drop),
            ]
        )
        body.add_sheet(corners, "panel", "metal")
        for x in (-length / 2 + 0.1, length / 2 - 0.1):
            body.tube((x, 0, 0), (x, 0, 0.68), 0.04, "metal", 4)
        return body
    low, high = rectangle(length, width), rectangle(length * 0.7, width * 0.6)
    body.loft(low, high, 0.0, between(rng, 0.15, 0.6), "sheet")
    return body
