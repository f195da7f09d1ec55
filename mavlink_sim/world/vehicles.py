"""The solids of vehicles: car, truck, bicycle, boat. Frame and units as in `solids`."""

from __future__ import annotations

import math

import numpy as np

from mavlink_sim.world.solids import Body, Points, Triple, between, disc, inset


def wheel(body: Body, x: float, y: float, radius: float, clear: float, sides: int = 12) -> None:
    """A wheel on the ground.

    Its outer disc is just outside the vehicle's side at y, and the rest of the tyre is under the vehicle
    (below `clear`), so that it does not intersect the body.
    """
    side = math.copysign(1.0, y)
    body.tube((x, y, radius), (x, y + side * 0.035, radius), radius, "tyre", sides)
    outer = (x, y + side * 0.035, radius)
    body.add_decal(disc(outer, radius * 0.62, 8, 1), "hub", (0.0, side, 0.0))
    body.add_decal(disc(outer, radius * 0.2, 5, 1), "trim", (0.0, side, 0.0))
    body.box((x, y - side * 0.11, clear / 2), (radius * 1.5, 0.2, clear), "tyre")


def car(rng: np.random.Generator) -> Body:
    """A saloon, hatchback, estate or off-roader, about 4.3 × 1.8 × 1.5 m, facing +x."""
    style = ("saloon", "hatchback", "estate", "tall")[int(rng.integers(4))]
    tall = style == "tall"
    length = between(rng, 4.15, 4.75) if style != "hatchback" else between(rng, 3.7, 4.2)
    width = between(rng, 1.72, 1.88)
    height = between(rng, 1.62, 1.82) if tall else between(rng, 1.4, 1.52)
    belt = height * (0.60 if not tall else 0.58)
    clear = 0.27 if tall else 0.19
    front, rear = length / 2, -length / 2
    body = Body()

    hood_start = front - length * between(rng, 0.24, 0.29)
    shoulders = np.array(
        [
            (rear + 0.12, clear),
            (front - 0.16, clear),
            (front, clear + 0.2),
            (front - 0.04, belt * 0.74),
            (front - 0.22, belt * 0.86),
            (hood_start, belt),
            (rear + 0.1, belt),
            (rear, belt * 0.8),
            (rear + 0.02, clear + 0.16),
        ]
    )
    body.extrude(
        shoulders, width / 2, "paint", slots=["under"] + ["paint"] * 8, top_half_width=width / 2 - 0.05
    )

    base_front = hood_start + 0.18
    base_rear = rear + {"saloon": length * 0.19, "hatchback": 0.12, "estate": 0.1, "tall": 0.1}[style]
    roof_front = base_front - (height - belt) * between(rng, 1.05, 1.35)
    rake = {"saloon": 1.0, "hatchback": 0.62, "estate": 0.38, "tall": 0.25}[style]
    roof_rear = base_rear + (height - belt) * rake
    cabin_w, roof_w = width - 0.14, width - 0.46

    def plan(x0: float, x1: float, w: float) -> Points:
        return np.array([(x0, -w / 2), (x1, -w / 2), (x1, w / 2), (x0, w / 2)])

    left, windscreen, right, back = body.loft(
        plan(base_rear, base_front, cabin_w),
        plan(roof_rear, roof_front, roof_w),
        belt - 0.03,
        height,
        "paint",
        top_slot="roof",
    )
    steep = (height - belt) or 1.0
    body.add_decal(inset(windscreen, 0.05, 0.95, 0.08, 0.93), "glass", (steep, 0, base_front - roof_front))
    body.add_decal(inset(back, 0.07, 0.93, 0.16, 0.9), "glass", (-steep, 0, roof_rear - base_rear))
    for flank, outwards in ((left, -1.0), (right, 1.0)):
        tilt = (cabin_w - roof_w) / 2
        edges = ((0.06, 0.47), (0.51, 0.93)) if outwards < 0 else ((0.07, 0.49), (0.53, 0.94))
        for low, high in edges:
            body.add_decal(inset(flank, low, high, 0.12, 0.88), "glass", (0, outwards * steep, tilt))
        y = outwards * (width / 2 - 0.01)
        seam = 0.25 * base_rear + 0.75 * base_front - 0.25
        for x in (seam, seam - 1.05):
            line = np.array(
                [(x, y, clear + 0.14), (x + 0.03, y, clear + 0.14), (x + 0.03, y, belt), (x, y, belt)]
            )
            body.add_decal(line, "under", (0, outwards, 0))
        body.box((base_front - 0.3, outwards * (width / 2 + 0.06), belt + 0.08), (0.16, 0.18, 0.13), "paint")

    radius = 0.36 if tall else 0.315
    for x in (front - 0.82, rear + 0.78):
        for side in (-1.0, 1.0):
            arch = disc((x, side * width / 2, radius), radius * 1.2, 10, 1)
            body.add_decal(np.maximum(arch, (-9.0, -9.0, clear)), "under", (0, side, 0))
            wheel(body, x, side * width / 2, radius, clear)

    for side in (-1.0, 1.0):
        y = side * (width / 2 - 0.27)
        body.box((front - 0.01, y, belt * 0.69), (0.06, 0.38, 0.14), "headlight")
        body.box((rear - 0.01, y + side * 0.03, belt * 0.76), (0.05, 0.3, 0.17), "taillight")
    body.box((front + 0.005, 0, clear + 0.16), (0.03, width * 0.62, 0.16), "under")
    body.box((rear - 0.01, 0, clear + 0.1), (0.05, width * 0.9, 0.14), "under")
    body.box((front + 0.03, 0, clear + 0.17), (0.02, 0.5, 0.11), "plate")
    body.box((rear - 0.01, 0, clear + 0.36), (0.03, 0.5, 0.11), "plate")
    if style in ("estate", "tall") and rng.random() < 0.6:
        for side in (-1.0, 1.0):
            rail = side * (roof_w / 2 - 0.08)
            body.box(((roof_front + roof_rear) / 2, rail, height + 0.03), (1.5, 0.05, 0.06), "trim")
    if rng.random() < 0.25:
        glass = plan(-0.55, 0.15, 0.9) + np.array(((roof_front + roof_rear) / 2 + 0.1, 0))
        body.add_decal(np.column_stack([glass, np.full(4, height)]), "glass", (0, 0, 1))
    return body


def truck(rng: np.random.Generator) -> Body:
    """A lorry with a box, a tarpaulin, a tank or a flat bed, about 7 × 2.4 × 3 m, facing +x."""
    style = ("box", "box", "tarpaulin", "tank", "flat")[int(rng.integers(5))]
    length, width = between(rng, 6.4, 7.8), between(rng, 2.25, 2.5)
    height = between(rng, 2.9, 3.4)
    front, rear = length / 2, -length / 2
    cab = between(rng, 1.7, 2.1)
    deck, cab_top = 0.95, between(rng, 2.45, 2.8)
    body = Body()
    body.box(((rear + front - cab) / 2, 0, 0.75), (length - cab + 0.2, 0.9, 0.3), "under")

    back = front - cab
    profile = np.array([(back, 0.5), (front, 0.5), (front, 1.35), (front - 0.28, cab_top), (back, cab_top)])
    body.extrude(profile, width / 2 - 0.04, "paint", top_half_width=width / 2 - 0.14)
    half = width / 2 - 0.3
    screen = np.array(
        [
            (front - 0.01, -half, 1.42),
            (front - 0.01, half, 1.42),
            (front - 0.24, half, cab_top - 0.2),
            (front - 0.24, -half, cab_top - 0.2),
        ]
    )
    body.add_decal(screen, "glass", (1.0, 0, 0.2))
    for side in (-1.0, 1.0):
        y = side * (width / 2 - 0.05)
        window = np.array(
            [
                (back + 0.55, y, 1.5),
                (front - 0.28, y, 1.5),
                (front - 0.45, y - side * 0.06, cab_top - 0.28),
                (back + 0.55, y - side * 0.06, cab_top - 0.28),
            ]
        )
        body.add_decal(window, "glass", (0, side, 0.06))
        body.box((front + 0.02, side * (width / 2 - 0.4), 0.78), (0.05, 0.42, 0.2), "headlight")
        body.box((front - 0.18, side * (width / 2 + 0.14), 1.85), (0.12, 0.2, 0.42), "under")
        body.box((rear - 0.03, side * (width / 2 - 0.3), 0.8), (0.05, 0.4, 0.18), "taillight")
        body.box((back - 0.75, side * (width / 2 - 0.32), 0.66), (0.9, 0.4, 0.42), "hub")
    body.box((front + 0.03, 0, 0.5), (0.06, width - 0.1, 0.28), "under")
    grille = np.array([(front, -0.62, 0.95), (front, 0.62, 0.95), (front, 0.62, 1.25), (front, -0.62, 1.25)])
    body.add_decal(grille, "under", (1, 0, 0))
    body.box((front + 0.07, 0, 0.55), (0.05, 0.52, 0.12), "plate")

    start, end = rear, back - 0.18
    middle, run = (start + end) / 2, end - start
    if style == "tank":
        radius = min(width, height - deck) / 2 - 0.06
        body.tube(
            (start, 0, deck + radius), (end, 0, deck + radius), radius, "cargo", 12, cap_slot="cargo_end"
        )
        body.box((middle, 0, deck + 2 * radius + 0.05), (run * 0.7, 0.4, 0.1), "under")
    elif style == "flat":
        body.box((middle, 0, deck + 0.05), (run, width, 0.14), "deck")
        body.box((end - 0.06, 0, deck + 0.5), (0.1, width, 0.9), "cargo")
        for side in (-1.0, 1.0):
            body.box((middle, side * (width / 2 - 0.03), deck + 0.3), (run, 0.06, 0.42), "cargo")
        for index in range(int(rng.integers(0, 4))):
            size = between(rng, 0.7, 1.2)
            body.box(
                (start + 0.8 + index * 1.35, between(rng, -0.4, 0.4), deck + 0.12 + size / 2),
                (size, size, size),
                "load",
            )
    else:
        body.box((middle, 0, (deck + height) / 2), (run, width, height - deck), "cargo", top_slot="cargo_top")
        for side in (-1.0, 1.0):
            y = side * width / 2
            band = np.array(
                [(start + 0.1, y, 1.7), (end - 0.1, y, 1.7), (end - 0.1, y, 2.2), (start + 0.1, y, 2.2)]
            )
            body.add_decal(band, "stripe", (0, side, 0))
            if style == "tarpaulin":
                for x in np.arange(start + 0.5, end, 0.75):
                    fold = np.array(
                        [(x, y, deck), (x + 0.05, y, deck), (x + 0.05, y, height), (x, y, height)]
                    )
                    body.add_decal(fold, "under", (0, side, 0))
        for y in (-width / 4, width / 4):
            door = np.array(
                [
                    (start, y - width / 4 + 0.06, deck + 0.08),
                    (start, y + width / 4 - 0.06, deck + 0.08),
                    (start, y + width / 4 - 0.06, height - 0.1),
                    (start, y - width / 4 + 0.06, height - 0.1),
                ]
            )
            body.add_decal(door, "cargo_end", (-1, 0, 0))

    radius = 0.48
    axles = [front - 1.0, rear + 1.15] + ([rear + 2.2] if length > 7.0 else [])
    for x in axles:
        for side in (-1.0, 1.0):
            wheel(body, x, side * (width / 2 - 0.04), radius, 0.5)
    return body


def bicycle(rng: np.random.Generator) -> Body:
    """An upright bicycle, about 1.75 m long, facing +x."""
    body = Body()
    radius = between(rng, 0.32, 0.35)
    base = between(rng, 1.0, 1.1)
    rear, front = -base / 2, base / 2
    for x in (rear, front):
        _spoked_wheel(body, x, radius)
    bottom = (rear + 0.42, 0.0, radius - 0.05)
    seat_top = (rear + 0.26, 0.0, between(rng, 0.78, 0.86))
    head_low, head_high = (front - 0.2, 0.0, 0.62), (front - 0.27, 0.0, 0.86)
    tube = 0.024
    low_entry = rng.random() < 0.35
    top_end = seat_top if not low_entry else (bottom[0] - 0.03, 0.0, bottom[2] + 0.2)
    body.tube(bottom, seat_top, tube, "paint", 4)
    body.tube(bottom, head_low, tube * 1.2, "paint", 4)
    body.tube(top_end, (head_high[0], 0, head_high[2] - 0.06), tube, "paint", 4)
    body.tube(head_low, (head_high[0] - 0.03, 0, 0.98), tube, "paint", 4)
    for side in (-0.05, 0.05):
        body.tube((rear, side, radius), (bottom[0], side * 0.4, bottom[2]), 0.013, "paint", 4)
        body.tube((rear, side, radius), (seat_top[0], side * 0.4, seat_top[2] - 0.1), 0.013, "paint", 4)
        body.tube((front, side, radius), (head_low[0], side * 0.7, head_low[2]), 0.018, "paint", 4)
    body.tube(seat_top, (seat_top[0] - 0.05, 0, 0.95), 0.018, "trim", 4)
    body.loft(
        np.array([(-0.14, -0.08), (0.14, -0.025), (0.14, 0.025), (-0.14, 0.08)]),
        np.array([(-0.14, -0.08), (0.14, -0.025), (0.14, 0.025), (-0.14, 0.08)]),
        0.95,
        1.0,
        "tyre",
        offset=(seat_top[0] - 0.05, 0.0),
    )
    bar = (head_high[0] - 0.03, 0.0, 1.0)
    reach = between(rng, 0.26, 0.31)
    for side in (-1.0, 1.0):
        grip = (bar[0] - 0.1, side * reach, 1.02)
        body.tube(bar, (bar[0] + 0.05, side * reach * 0.7, 1.02), 0.015, "trim", 4)
        body.tube((bar[0] + 0.05, side * reach * 0.7, 1.02), grip, 0.02, "tyre", 4)
    body.tube((bottom[0], -0.06, bottom[2]), (bottom[0], 0.06, bottom[2]), 0.09, "trim", 8)
    body.tube((bottom[0], 0.07, bottom[2]), (bottom[0] + 0.16, 0.07, bottom[2] - 0.06), 0.014, "trim", 4)
    body.tube((bottom[0], -0.07, bottom[2]), (bottom[0] - 0.16, -0.07, bottom[2] + 0.06), 0.014, "trim", 4)
    body.box((bottom[0] + 0.16, 0.13, bottom[2] - 0.06), (0.09, 0.1, 0.025), "tyre")
    body.box((bottom[0] - 0.16, -0.13, bottom[2] + 0.06), (0.09, 0.1, 0.025), "tyre")
    if rng.random() < 0.4:
        body.box((front + 0.05, 0, 0.98), (0.3, 0.34, 0.22), "deck")
    if rng.random() < 0.5:
        body.box((rear - 0.02, 0, 2 * radius + 0.08), (0.38, 0.13, 0.025), "under")
    return body


def _spoked_wheel(body: Body, x: float, radius: float, sides: int = 14) -> None:
    inner, half = radius * 0.86, 0.022
    angles = np.arange(sides) * 2 * math.pi / sides
    rim = np.column_stack([np.cos(angles), np.zeros(sides), np.sin(angles)])
    hub = np.array([x, 0.0, radius])
    across = np.array([0.0, half, 0.0])
    for i in range(sides):
        j = (i + 1) % sides
        a, b = hub + rim[i] * radius, hub + rim[j] * radius
        c, d = hub + rim[j] * inner, hub + rim[i] * inner
        body.add_solid(
            [
                np.array([a, b, c, d]) - across,
                np.array([a, b, c, d]) + across,
                np.array([a - across, b - across, b + across, a + across]),
                np.array([c - across, d - across, d + across, c + across]),
            ],
            "tyre",
        )
    for angle in np.arange(4) * math.pi / 4 + 0.3:
        ray = np.array([math.cos(angle), 0.0, math.sin(angle)])
        turn = np.array([-ray[2], 0.0, ray[0]]) * 0.004
        spoke = [
            hub - ray * inner - turn,
            hub + ray * inner - turn,
            hub + ray * inner + turn,
            hub - ray * inner + turn,
        ]
        body.add_sheet(np.array(spoke), "hub")
    axle = np.array((0.0, 0.045, 0.0))
    body.tube(hub - axle, hub + axle, 0.03, "trim", 5)


def boat(rng: np.random.Generator) -> Body:
    """A motor boat, sailing boat or rowing boat, about 5 × 2 m, its bow towards +x."""
    style = ("motor", "sail", "open")[int(rng.integers(3))]
    length, width = between(rng, 4.4, 6.2), between(rng, 1.8, 2.3)
    if style == "open":
        length, width = length * 0.8, width * 0.8
    high = between(rng, 0.72, 0.95) if style != "open" else between(rng, 0.5, 0.62)
    outline = np.array(
        [
            (-0.5, -0.40),
            (-0.2, -0.49),
            (0.15, -0.46),
            (0.36, -0.27),
            (0.5, 0.0),
            (0.36, 0.27),
            (0.15, 0.46),
            (-0.2, 0.49),
            (-0.5, 0.40),
        ]
    )
    deck = outline * (length, width)
    keel = outline * (length * 0.86, width * 0.5) + (-length * 0.04, 0)
    waist = outline * (length * 0.965, width * 0.9) + (-length * 0.008, 0)
    body = Body()
    body.loft(keel, waist, 0.0, high * 0.62, "bottom")
    body.loft(waist, deck, high * 0.62, high, "paint", top_slot="rail")
    well = outline * (length * 0.88, width * 0.82)
    body.add_decal(np.column_stack([well, np.full(len(well), high)]), "deck", (0, 0, 1))
    if style == "open":
        shade = outline * (length * 0.8, width * 0.68)
        body.add_decal(np.column_stack([shade, np.full(len(shade), high)]), "under", (0, 0, 1))
        for x in (-0.28, 0.0, 0.24):
            body.box((x * length, 0, high + 0.03), (0.26, width * 0.8, 0.05), "seat")
        if rng.random() < 0.6:
            for side in (-1.0, 1.0):
                end = (-0.3 * length, side * (width / 2 + 0.7), high * 0.75)
                body.tube((0.1 * length, side * 0.2, high + 0.12), end, 0.035, "seat", 4)
        return body
    if style == "motor":
        cabin = np.array([(-0.16, -0.32), (0.2, -0.28), (0.2, 0.28), (-0.16, 0.32)]) * (length, width)
        roof = np.array([(-0.15, -0.28), (0.07, -0.25), (0.07, 0.25), (-0.15, 0.28)]) * (length, width)
        top = high + between(rng, 0.7, 0.95)
        sides = body.loft(cabin, roof, high, top, "cabin", top_slot="cabin_top")
        looks: list[Triple] = [(0, -1, 0.1), (1, 0, 0.9), (0, 1, 0.1), (-1, 0, 0)]
        for wall, look in zip(sides, looks, strict=True):
            body.add_decal(inset(wall, 0.08, 0.92, 0.3, 0.86), "glass", look)
        body.box((-0.3 * length, 0, high + 0.2), (0.4, width * 0.6, 0.35), "seat")
        body.box((-length / 2 - 0.12, 0, high * 0.8), (0.36, 0.38, 0.75), "motor")
        body.tube((0.3 * length, 0, high), (0.46 * length, 0, high + 0.35), 0.02, "trim", 4)
    else:
        cabin = np.array([(-0.12, -0.26), (0.22, -0.16), (0.22, 0.16), (-0.12, 0.26)]) * (length, width)
        sides = body.loft(cabin, cabin * 0.88, high, high + 0.42, "cabin", top_slot="cabin_top")
        for wall, across in ((sides[0], -1.0), (sides[2], 1.0)):
            body.add_decal(inset(wall, 0.15, 0.85, 0.3, 0.75), "glass", (0.1, across, 0.1))
        mast, tall = 0.12 * length, high + between(rng, 4.2, 5.4)
        body.tube((mast, 0, high), (mast, 0, tall), 0.055, "trim", 5)
        boom_end = (-0.38 * length, 0.0, high + 0.75)
        body.tube((mast, 0, high + 0.75), boom_end, 0.045, "trim", 4)
        if rng.random() < 0.65:
            main = np.array(
                [(mast - 0.06, 0, high + 0.85), (boom_end[0], 0, high + 0.85), (mast - 0.06, 0, tall - 0.1)]
            )
            body.add_sheet(main, "sail")
            jib = np.array(
                [(mast + 0.08, 0, tall - 0.6), (mast + 0.15, 0, high + 0.5), (length * 0.47, 0, high + 0.1)]
            )
            body.add_sheet(jib, "sail")
        else:
            body.tube((mast, 0, high + 0.85), (boom_end[0], 0, high + 0.85), 0.12, "sail", 6)
    return body
