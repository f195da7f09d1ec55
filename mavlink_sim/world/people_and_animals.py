"""The solids of people, dogs and chairs. Frame and units as in `solids`."""

from __future__ import annotations

import math

import numpy as np

from mavlink_sim.world.solids import Body, Points, between, rectangle


def _swing(pivot: Points, length: float, forward_rad: float, outward: float = 0.0) -> Points:
    """The end of a limb at a pivot, swung forward and `outward` metres to the side."""
    drop = math.sqrt(max(length**2 - outward**2, 0.01))
    end: Points = pivot + np.array((drop * math.sin(forward_rad), outward, -drop * math.cos(forward_rad)))
    return end


def person(rng: np.random.Generator) -> Body:
    """A person standing, walking, waving or with spread arms, about 1.75 m tall, facing +x."""
    pose = ("stand", "walk", "walk", "wave", "spread", "run")[int(rng.integers(6))]
    tall = between(rng, 1.58, 1.9)
    build = between(rng, 0.88, 1.15)
    body = Body()
    stride = {"stand": 0.04, "walk": 0.42, "wave": 0.06, "spread": 0.1, "run": 0.75}[pose]
    hip_z = tall * 0.5 * (0.97 if pose == "run" else 1.0)
    thigh, shin = tall * 0.235, tall * 0.225
    skirt = rng.random() < 0.2
    shorts = rng.random() < 0.3
    for side, phase in ((-1.0, 1.0), (1.0, -1.0)):
        hip = np.array([0.0, side * 0.092 * build, hip_z])
        knee = _swing(hip, thigh, phase * stride, side * 0.015)
        bend = 0.9 * stride if phase < 0 else 0.25 * stride
        ankle = _swing(knee, shin, phase * stride - bend, 0.0)
        ankle[2] = max(ankle[2], 0.07)
        body.tube(hip, knee, 0.088 * build, "trousers", 6, 0.066 * build)
        body.tube(knee, ankle, 0.064 * build, "skin" if shorts or skirt else "trousers", 6, 0.046 * build)
        body.box((ankle[0] + 0.06, ankle[1], max(ankle[2] - 0.03, 0.045)), (0.27, 0.1, 0.09), "shoes")
    shoulder_z = tall * 0.82
    lean = {"run": 0.12, "walk": 0.03}.get(pose, 0.0)
    leaned = np.array((lean, 0.0))
    hips, chest = rectangle(0.22 * build, 0.33 * build), rectangle(0.25 * build, 0.44 * build)
    body.loft(hips, chest * 0.92, hip_z + 0.03, hip_z + tall * 0.14, "shirt")
    body.loft(chest * 0.92, chest + leaned, hip_z + tall * 0.14, shoulder_z - 0.06, "shirt")
    body.loft(chest + leaned, chest * 0.6 + leaned, shoulder_z - 0.06, shoulder_z + 0.02, "shirt")
    belt = rectangle(0.235 * build, 0.345 * build)
    if skirt:
        body.loft(belt * 1.75, belt, hip_z - tall * 0.2, hip_z + 0.04, "trousers")
    else:
        body.loft(belt * 1.02, belt, hip_z - 0.08, hip_z + 0.03, "trousers")
    upper, fore = tall * 0.175, tall * 0.16
    sleeve = rng.random() < 0.55
    for side, phase in ((-1.0, -1.0), (1.0, 1.0)):
        shoulder = np.array([lean, side * 0.235 * build, shoulder_z - 0.03])
        angle, outward, elbow_bend = phase * stride * 0.9, side * 0.04, 0.25 + stride
        if pose == "wave" and side > 0:
            angle, outward, elbow_bend = 2.6, side * 0.14, 0.3
        elif pose == "spread":
            angle, outward, elbow_bend = 0.0, side * upper * 0.92, 0.0
        elbow = _swing(shoulder, upper, angle, outward)
        hand = elbow + (elbow - shoulder) * (fore / upper)
        if pose != "spread":
            hand = _swing(elbow, fore, angle + elbow_bend, outward * 0.4)
        body.tube(shoulder, elbow, 0.055 * build, "shirt", 5, 0.046 * build)
        body.tube(elbow, hand, 0.044 * build, "shirt" if sleeve else "skin", 5, 0.034 * build)
        body.ellipsoid((float(hand[0]), float(hand[1]), float(hand[2])), (0.05, 0.04, 0.055), "skin", 5, 3)
    neck = np.array([lean, 0.0, shoulder_z])
    body.tube(neck, neck + np.array((0.01, 0, 0.09)), 0.055, "skin", 6)
    head_z = tall - 0.125
    body.ellipsoid((lean + 0.03, 0, head_z), (0.1, 0.082, 0.125), "skin", 8, 5)
    if rng.random() < 0.2:
        body.tube((lean + 0.02, 0, head_z + 0.05), (lean + 0.02, 0, head_z + 0.12), 0.115, "hat", 8, 0.09)
        brim = rectangle(0.14, 0.17) + np.array((lean + 0.15, 0))
        body.loft(brim, brim, head_z + 0.045, head_z + 0.06, "hat")
    else:
        body.ellipsoid((lean - 0.005, 0, head_z + 0.035), (0.112, 0.096, 0.105), "hair", 8, 4)
    if rng.random() < 0.25:
        body.box((lean - 0.22 * build, 0, shoulder_z - 0.24), (0.18, 0.3, 0.42), "bag")
    return body


def dog(rng: np.random.Generator) -> Body:
    """A dog standing or trotting, 0.7 to 1.1 m long, facing +x."""
    size = between(rng, 0.85, 1.2)
    stocky = between(rng, 0.85, 1.2)
    back, length = 0.52 * size, 0.62 * size
    stride = between(rng, 0.0, 0.5)
    body = Body()
    rear, front = -length / 2, length / 2
    chest, waist = 0.125 * size * stocky, 0.10 * size * stocky
    body.tube((rear, 0, back), (0, 0, back - 0.01), waist, "coat", 7, chest * 0.95, squash=1.15)
    body.tube((0, 0, back - 0.01), (front + 0.03, 0, back + 0.01), chest * 0.95, "coat", 7, chest, squash=1.2)
    body.ellipsoid((rear, 0, back - 0.01), (waist * 1.1, waist, waist * 1.2), "coat", 7, 4)
    body.ellipsoid((front + 0.02, 0, back), (chest, chest * 0.95, chest * 1.25), "chest", 7, 4)
    for x, forwards in ((rear, 1.0), (front, -1.0)):
        for side in (-1.0, 1.0):
            hip = np.array([x, side * 0.07 * size * stocky, back - 0.04])
            knee = _swing(hip, back * 0.45, side * forwards * stride + (0.2 if x < 0 else -0.1))
            foot = np.array(
                [knee[0] - 0.04 * (1 if x < 0 else 0) + side * forwards * stride * 0.08, knee[1], 0.035]
            )
            body.tube(hip, knee, 0.06 * size * stocky, "coat", 5, 0.038 * size)
            body.tube(knee, foot, 0.034 * size, "legs", 5, 0.028 * size)
            body.box((float(foot[0]) + 0.02, float(foot[1]), 0.025), (0.1 * size, 0.06 * size, 0.05), "legs")
    head = np.array([front + 0.2 * size, 0.0, back + 0.22 * size])
    body.tube((front, 0, back + 0.05), head - (0.03, 0, 0), 0.085 * size * stocky, "coat", 6, 0.07 * size)
    body.ellipsoid(
        (float(head[0]), 0, float(head[2])), (0.11 * size, 0.085 * size, 0.09 * size), "coat", 7, 4
    )
    nose = head + np.array((0.2 * size, 0, -0.045 * size))
    body.tube(head + np.array((0.06, 0, -0.02)), nose, 0.055 * size, "muzzle", 6, 0.036 * size)
    body.ellipsoid((float(nose[0]), 0, float(nose[2]) + 0.01), (0.025, 0.025, 0.022), "nose", 5, 3)
    pricked = rng.random() < 0.5
    for side in (-1.0, 1.0):
        root = head + np.array((-0.02 * size, side * 0.06 * size, 0.06 * size))
        tip = root + ((-0.01, side * 0.015, 0.1 * size) if pricked else (0.0, side * 0.05, -0.11 * size))
        body.tube(root, tip, 0.035 * size, "ears", 4, 0.012)
    raised = between(rng, -0.15, 0.3) * size
    tail = np.array([rear - 0.02, 0.0, back + 0.06 * size])
    middle = tail + np.array((-0.14 * size, 0, raised * 0.4))
    body.tube(tail, middle, 0.032 * size, "coat", 5, 0.026 * size)
    body.tube(middle, middle + np.array((-0.1 * size, 0.02, raised)), 0.026 * size, "coat", 5, 0.012)
    if rng.random() < 0.5:
        body.tube(
            (front + 0.06, 0, back + 0.1), (front + 0.09, 0, back + 0.13), 0.1 * size * stocky, "collar", 7
        )
    return body


def chair(rng: np.random.Generator) -> Body:
    """A kitchen, garden, office or arm chair; its back is towards -x."""
    style = ("plain", "garden", "office", "arm")[int(rng.integers(4))]
    width, depth = between(rng, 0.42, 0.5), between(rng, 0.42, 0.5)
    seat, top = between(rng, 0.42, 0.48), between(rng, 0.84, 1.0)
    body = Body()
    if style == "arm":
        width, depth, top = width + 0.28, depth + 0.24, top - 0.08
        body.box((0, 0, 0.24), (depth, width, 0.3), "fabric")
        body.box((0.05, 0, 0.43), (depth - 0.18, width - 0.26, 0.1), "cushion")
        body.box((-depth / 2 + 0.09, 0, (0.2 + top) / 2), (0.18, width, top - 0.2), "fabric")
        for side in (-1.0, 1.0):
            body.box((0.03, side * (width / 2 - 0.07), 0.36), (depth - 0.06, 0.14, 0.52), "fabric")
            for x in (-depth / 2 + 0.07, depth / 2 - 0.07):
                body.box((x, side * (width / 2 - 0.08), 0.05), (0.06, 0.06, 0.1), "frame")
        return body
    body.box((0, 0, seat), (depth, width, 0.05 if style != "office" else 0.09), "fabric")
    lean = between(rng, 0.04, 0.12)
    low = np.array(
        [
            (-depth / 2, -width / 2),
            (-depth / 2 + 0.035, -width / 2),
            (-depth / 2 + 0.035, width / 2),
            (-depth / 2, width / 2),
        ]
    )
    if style == "office":
        body.loft(low * (1, 0.95), low * (1, 0.85) - (lean, 0), seat + 0.14, top + 0.08, "fabric")
        body.box((-depth / 2 + 0.03, 0, seat + 0.1), (0.05, 0.08, 0.24), "frame")
        body.tube((0, 0, 0.1), (0, 0, seat - 0.03), 0.035, "frame", 6)
        for angle in np.arange(5) * 2 * math.pi / 5:
            end = (0.3 * math.cos(angle), 0.3 * math.sin(angle), 0.07)
            body.tube((0, 0, 0.11), end, 0.025, "frame", 4)
            body.ellipsoid((end[0], end[1], 0.04), (0.04, 0.03, 0.04), "frame", 5, 3)
        if rng.random() < 0.6:
            _arms(body, width, depth, seat, "frame")
        return body
    thick = 0.04 if style == "plain" else 0.035
    for side in (-1.0, 1.0):
        y = side * (width / 2 - 0.025)
        splay = 0.04 if style == "garden" else 0.015
        body.tube(
            (depth / 2 - 0.03, y, seat),
            (depth / 2 + splay - 0.03, y + side * splay, 0),
            thick * 0.7,
            "frame",
            4,
        )
        body.tube(
            (-depth / 2 + 0.02, y, seat), (-depth / 2 - splay, y + side * splay, 0), thick * 0.7, "frame", 4
        )
        body.tube((-depth / 2 + 0.02, y, seat), (-depth / 2 + 0.02 - lean, y, top), thick * 0.65, "frame", 4)
    if rng.random() < 0.5:
        body.loft(low * (1, 0.92), low * (1, 0.88) - (lean, 0), seat + 0.12, top, "fabric")
    else:
        for share in (0.35, 0.65, 0.95):
            z = seat + (top - seat) * share
            body.box((-depth / 2 + 0.02 - lean * share, 0, z), (0.03, width - 0.04, 0.07), "fabric")
    if style == "garden":
        _arms(body, width, depth, seat, "fabric")
    return body


def _arms(body: Body, width: float, depth: float, seat: float, slot: str) -> None:
    for side in (-1.0, 1.0):
        y = side * (width / 2 + 0.01)
        body.box((0.0, y, seat + 0.21), (depth - 0.04, 0.055, 0.035), slot)
        body.box((depth / 2 - 0.08, y, seat + 0.1), (0.04, 0.04, 0.2), slot)
