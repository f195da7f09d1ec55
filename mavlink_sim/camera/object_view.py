"""One object in a camera: the face, the depth and the colour at each pixel.

Faces are painted as numbers, far to near, into a small image; depth then comes from a table by that number.
The reciprocal of a plane's depth is linear in the pixel, so depth is exact at every pixel. `painting` colours
the visible pixels of all objects at once.
"""

from __future__ import annotations

import colorsys
import copy
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.ground_view import Matrix, View
from mavlink_sim.world.depth_sort import clip_polygon
from mavlink_sim.world.fiducials import Print, printed_side, reflectance
from mavlink_sim.world.shapes import Shape
from mavlink_sim.world.textures import Plane
from mavlink_sim.world.world import Light, Sky, WorldObject
from vision.rotation import matrix_from_euler

Colour = tuple[float, float, float]

CAR_PAINTS: tuple[Colour, ...] = (
    (232, 232, 230),
    (190, 188, 186),
    (120, 118, 116),
    (45, 44, 44),
    (30, 26, 24),
    (38, 34, 168),
    (150, 84, 36),
    (178, 122, 48),
    (84, 46, 28),
    (52, 92, 42),
    (40, 150, 214),
    (32, 96, 220),
    (60, 60, 120),
    (150, 170, 190),
    (28, 28, 92),
    (200, 180, 120),
)
SKINS: tuple[Colour, ...] = (
    (172, 200, 236),
    (150, 182, 224),
    (120, 156, 206),
    (84, 118, 172),
    (56, 82, 130),
    (40, 56, 90),
)
HAIR: tuple[Colour, ...] = (
    (24, 26, 30),
    (30, 44, 66),
    (60, 100, 140),
    (110, 170, 210),
    (180, 184, 186),
    (26, 48, 108),
)
COATS: tuple[Colour, ...] = (
    (36, 38, 42),
    (48, 74, 112),
    (92, 138, 182),
    (168, 196, 218),
    (214, 222, 228),
    (110, 112, 116),
    (40, 70, 140),
)
AUTUMN: tuple[Colour, ...] = (
    (28, 60, 168),
    (30, 104, 206),
    (44, 160, 214),
    (40, 84, 116),
    (52, 44, 132),
    (70, 150, 170),
    (196, 184, 222),
    (84, 96, 104),
)
"""Of leaves: red, orange, yellow, brown, purple, pale; blossom; bare twigs."""
WOOD: tuple[Colour, ...] = ((70, 110, 150), (52, 84, 122), (110, 150, 186), (60, 70, 84), (140, 160, 170))

FIXED: dict[str, Colour] = {
    "tyre": (30, 30, 31),
    "under": (34, 34, 35),
    "glass": (72, 58, 46),
    "headlight": (236, 240, 244),
    "taillight": (36, 30, 176),
    "plate": (226, 232, 234),
    "trim": (150, 150, 152),
    "hub": (168, 168, 170),
    "nose": (24, 24, 26),
    "motor": (44, 44, 46),
    "lamp": (225, 235, 240),
    "dark": (58, 60, 64),
    "metal": (146, 146, 148),
    "panel": (84, 44, 26),
    "rail": (206, 212, 216),
    "board": (236, 238, 238),
}


def _vivid(rng: np.random.Generator, low: float = 0.15, high: float = 0.95) -> Colour:
    red, green, blue = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.1, 0.9), rng.uniform(low, high))
    return (blue * 235, green * 235, red * 235)


def _one_of(rng: np.random.Generator, colours: tuple[Colour, ...], spread: float = 0.12) -> Colour:
    blue, green, red = colours[int(rng.integers(len(colours)))]
    gain = rng.uniform(1 - spread, 1 + spread, 3) * rng.uniform(1 - spread, 1 + spread)
    return (float(blue * gain[0]), float(green * gain[1]), float(red * gain[2]))


def _near(rng: np.random.Generator, colour: Colour, spread: float = 0.15) -> Colour:
    return _one_of(rng, (colour,), spread)


def _colour(rng: np.random.Generator, class_name: str, slot: str, chosen: dict[str, Colour]) -> Colour:
    if slot in FIXED:
        return _near(rng, FIXED[slot], 0.08)
    if slot == "paint":
        if class_name in ("car", "truck"):
            return _one_of(rng, CAR_PAINTS)
        if class_name == "boat" and rng.random() < 0.6:
            return _near(rng, (228, 230, 230), 0.06)
        return _vivid(rng)
    if slot == "roof":
        if class_name == "car":
            return chosen["paint"] if rng.random() < 0.8 else _near(rng, (40, 40, 42))
        return _one_of(rng, ((60, 72, 150), (80, 84, 90), (70, 90, 120), (52, 56, 60)))
    if slot in ("cargo", "sail", "cabin", "wall"):
        pale = rng.random() < 0.55
        return _near(rng, (222, 226, 228), 0.08) if pale else _vivid(rng, 0.3, 0.9)
    if slot in ("cargo_top", "cargo_end"):
        return _near(rng, chosen["cargo"], 0.06)
    if slot == "cabin_top":
        return _near(rng, (218, 222, 224), 0.1)
    if slot in ("skin", "hair"):
        return _one_of(rng, SKINS if slot == "skin" else HAIR)
    if slot == "coat":
        return _one_of(rng, COATS)
    if slot in ("chest", "legs", "muzzle", "ears"):
        same = rng.random() < 0.6
        return _near(rng, chosen["coat"], 0.08) if same else _one_of(rng, COATS)
    if slot in ("wood", "deck", "seat", "lid", "hay", "bark"):
        if slot == "bark":
            return _near(rng, (58, 74, 92), 0.2)
        return _near(rng, (92, 168, 196)) if slot == "hay" else _one_of(rng, WOOD)
    if slot in ("leaves", "needles"):
        return _one_of(rng, ((40, 92, 56), (34, 74, 44), (48, 116, 84), (44, 100, 110)), 0.18)
    if slot == "autumn_leaves":
        return _one_of(rng, AUTUMN, 0.18)
    if slot == "stone":
        return _one_of(rng, ((128, 134, 138), (100, 110, 120), (150, 158, 164)))
    if slot == "frame":
        return _one_of(rng, ((40, 40, 42), (150, 150, 152), (60, 96, 140), (220, 222, 222)))
    if slot == "shoes":
        return _one_of(rng, ((30, 30, 32), (50, 70, 100), (220, 222, 224), (60, 50, 170)))
    if slot == "trousers":
        return _one_of(rng, ((92, 62, 40), (38, 36, 36), (70, 84, 100), (120, 150, 176), (130, 100, 70)), 0.2)
    return _vivid(rng)


@lru_cache(maxsize=4096)
def palette_of(class_name: str, slots: tuple[str, ...], appearance: int) -> tuple[Colour, ...]:
    """One colour for each slot, of an object of this class with this appearance seed."""
    rng = np.random.default_rng((appearance, 5))
    chosen: dict[str, Colour] = {}
    leading = [slot for slot in ("paint", "cargo", "coat") if slot in slots]
    for slot in [*leading, *(slot for slot in slots if slot not in leading)]:
        chosen[slot] = _colour(rng, class_name, slot, chosen)
    return tuple(chosen[slot] for slot in slots)


NEAR_M = 0.05
FAR_PX = 30000.0
"""Corners farther outside the image than this are clipped: drawing needs bounded integers."""
SUBPIXEL_BITS = 4
FACE_BITS = 10
"""A label is the object's number << FACE_BITS | face; the first object's number is 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Pixels of an object without occlusion.

    Attributes:
        left, top, right, bottom: its part of the image; right and bottom are past the end.
        pixels: (N,) int64, flat indices into the image.
        faces: (N,) the face covering each.
        inverse_depth: (N,) float32.
        face_colours: (F, 3) float32 BGR, not yet textured.
        inside_share: 0..1, share of its outline that lies inside the image.
    """

    left: int
    top: int
    right: int
    bottom: int
    pixels: NDArray[np.int64]
    faces: NDArray[np.int64]
    inverse_depth: Plane
    face_colours: Plane
    inside_share: float


class PlacedObject:
    """A world object prepared for drawing under one light."""

    def __init__(self, item: WorldObject, light: Light, sky: Sky) -> None:
        self.item = item
        self.sky, self.light = sky, light
        self.shape: Shape = item.shape
        if len(self.shape.normals) >= 1 << FACE_BITS:
            raise ValueError(f"a {item.class_name} has {len(self.shape.normals)} faces, too many to draw")
        self.ned_from_object = matrix_from_euler(item.roll_rad, item.pitch_rad, item.yaw_rad)
        self.origin = np.array(item.position_ned_m, np.float64)
        low, high = self.shape.low, self.shape.high
        if item.leans:  # about its centre: one that lies on its back is on the ground, not below it
            pivot = np.array([0.0, 0.0, (low[2] + high[2]) / 2 * item.scale])
            self.origin += pivot - self.ned_from_object @ pivot
        self.middle = self.origin + self.ned_from_object @ ((low + high) / 2) * item.scale
        self.radius_m = float(np.linalg.norm(high - low)) / 2 * item.scale
        self.sun = np.array(light.towards_sun_ned)
        self.normals_ned = self.shape.normals @ self.ned_from_object.T
        self.lit = self._lit()
        self._shadow: tuple[NDArray[np.float64], list[int]] | None = None

    def moved(self, item: WorldObject) -> PlacedObject | None:
        """The same object at another position, with its light and shadow. None if more has changed."""
        if replace(self.item, position_ned_m=item.position_ned_m) != item:
            return None
        twin = copy.copy(self)
        twin.item = item
        shift = np.subtract(item.position_ned_m, self.item.position_ned_m)
        twin.origin, twin.middle = self.origin + shift, self.middle + shift
        if self._shadow is not None and shift[2] == 0.0:
            corners, first = self._shadow
            twin._shadow = (corners + shift, first)
        else:
            twin._shadow = None
        return twin

    def _lit(self) -> Plane:
        """(F, 3) faces' colours under sun and sky, without mirroring."""
        shape = self.shape
        palette = np.array(palette_of(self.item.class_name, shape.slots, self.item.appearance))
        albedo = palette[shape.slot_of] * shape.shade[:, None]
        upwards = 0.5 - 0.5 * self.normals_ned[:, 2:]
        sunlit = np.maximum(self.normals_ned @ self.sun, 0.0)[:, None]
        light = self.light
        strength = light.ambient * (0.5 + 0.5 * upwards) + light.sun * sunlit * np.array(light.tint)
        return np.asarray(albedo * strength, np.float32)

    @property
    def shadow(self) -> tuple[NDArray[np.float64], list[int]]:
        """Outlines of the solids' shadows on the ground: (P, 3) NED corners, where each begins."""
        if self._shadow is None:
            turn, scale = self.ned_from_object, self.item.scale
            base = float(self.origin[2])
            if self.item.leans:  # along the NED axes: those of the object are not horizontal
                outlines, lowest = self.shape.leaning_shadow(self.sun, turn)
                base += lowest * scale
                turn = np.eye(3)
            else:
                outlines = self.shape.shadow(self.sun @ turn)
            flat = np.concatenate(outlines).astype(np.float64)
            turned = flat @ turn[:2, :2].T * scale + self.origin[:2]
            if base < 0.0:  # in the air: its shadow is farther from the sun
                turned += self.sun[:2] * (base / max(-float(self.sun[2]), 0.05))
            first = np.cumsum([0] + [len(outline) for outline in outlines]).tolist()
            self._shadow = (np.column_stack([turned, np.zeros(len(turned))]), first)
        return self._shadow

    def draw(self, view: View) -> Sighting | None:
        """Its pixels from `view` without occlusion, or None."""
        shape, scale = self.shape, self.item.scale
        eye = (view.eye - self.origin) @ self.ned_from_object / scale
        turn = view.pixel_from_ned @ self.ned_from_object * scale
        start = view.pixel_from_ned @ (self.origin - view.eye)
        corners = shape.corners @ turn.T + start
        depth = corners[:, 2]
        nearest, farthest = float(depth.min()), float(depth.max())
        if farthest < NEAR_M:
            return None
        height = shape.normals @ eye - shape.offsets
        facing = height > 1e-6
        if nearest >= NEAR_M:
            points = corners[:, :2] / depth[:, None]
            first: list[int] = shape.first.tolist()
        else:
            points, first, facing = _clipped(corners, shape, facing)
            if not len(points):
                return None
        low, high = points.min(axis=0), points.max(axis=0)
        left, top = max(0, math.floor(low[0])), max(0, math.floor(low[1]))
        right, bottom = min(view.width, math.ceil(high[0]) + 1), min(view.height, math.ceil(high[1]) + 1)
        if right <= left or bottom <= top:
            return None
        numbers = np.zeros((bottom - top, right - left), np.uint16)
        bounded = np.clip(points - (left, top), -FAR_PX, FAR_PX)
        fixed = np.rint(bounded * (1 << SUBPIXEL_BITS)).astype(np.int32)
        seen = facing.tolist()
        for solid in shape.tree.back_to_front(eye):
            for face in shape.faces_of[solid]:
                if seen[face]:
                    polygon = fixed[first[face] : first[face + 1]]
                    cv2.fillConvexPoly(numbers, polygon, face + 1, cv2.LINE_8, SUBPIXEL_BITS)
        painted = np.flatnonzero(numbers)
        if not len(painted):
            return None
        faces = numbers.ravel()[painted].astype(np.int64) - 1
        rows, columns = np.divmod(painted, right - left)
        rows += top
        columns += left

        rays = self.ned_from_object.T @ view.ned_from_pixel / scale
        with np.errstate(divide="ignore", invalid="ignore"):
            planes = np.where(facing[:, None], shape.normals @ rays / -height[:, None], 0.0)
        slopes = planes.astype(np.float32)
        x, y = columns.astype(np.float32), rows.astype(np.float32)
        inverse: Plane = slopes[:, 0].take(faces) * x
        inverse += slopes[:, 1].take(faces) * y
        inverse += slopes[:, 2].take(faces)
        np.clip(inverse, 1.0 / farthest, 1.0 / max(nearest, NEAR_M), out=inverse)
        pixels = rows * view.width + columns
        at_rim = left == 0 or top == 0 or right == view.width or bottom == view.height
        share = _inside_share(points, view) if at_rim else 1.0
        colours = self._view_colours(view, facing)
        return Sighting(left, top, right, bottom, pixels, faces, inverse, colours, share)

    def printed_brightness(
        self, printed: Print, view: View, faces: NDArray[np.int64], x: Plane, y: Plane
    ) -> Plane:
        """(N,) factors of the pixels of these faces of a plate: its print on one of them, 1 elsewhere."""
        brightness = np.ones(len(faces), np.float32)
        front = np.flatnonzero((self.shape.normals @ printed_side(printed)).take(faces) > 0.9)
        eye = (view.eye - self.origin) @ self.ned_from_object / self.item.scale
        rays = self.ned_from_object.T @ view.ned_from_pixel / self.item.scale
        brightness[front] = reflectance(printed, eye, rays, x[front], y[front])
        return brightness

    def _view_colours(self, view: View, facing: NDArray[np.bool_]) -> Plane:
        """(F, 3) faces' colours with reflections of sky and sun on glossy ones."""
        glossy = np.flatnonzero(facing & (self.shape.gloss > 0.0))
        if not len(glossy):
            return self.lit
        shape, normals = self.shape, self.normals_ned[glossy]
        middles = shape.corners[shape.first[glossy]] * self.item.scale @ self.ned_from_object.T + self.origin
        look = middles - view.eye
        look /= np.linalg.norm(look, axis=1, keepdims=True)
        against = (look * normals).sum(axis=1, keepdims=True)
        mirrored = look - 2 * against * normals
        gloss = shape.gloss[glossy][:, None]
        share = gloss * (0.12 + 0.88 * (1.0 + np.clip(against, -1, 0)) ** 3)
        rise = -mirrored[:, 2:]
        sky = np.array(self.sky.horizon) + (1 - np.exp(-4 * np.maximum(rise, 0))) * np.subtract(
            self.sky.zenith, self.sky.horizon
        )
        bright = self.light.ambient + 0.35 * self.light.sun
        scene = np.where(rise > 0, sky * min(1.0, bright * 1.4), np.array((58.0, 70.0, 72.0)) * bright)
        glint = np.maximum(mirrored @ self.sun, 0.0)[:, None] ** 40 * gloss * 190 * self.light.sun
        colours = self.lit.copy()
        colours[glossy] += ((scene - colours[glossy]) * share + glint).astype(np.float32)
        return colours


def within_view(
    placed: list[PlacedObject],
    middles: NDArray[np.float64],
    radii: NDArray[np.float64],
    view: View,
    within_m: float = math.inf,
) -> list[PlacedObject]:
    """The objects whose bounding sphere, (N, 3) and (N,) NED, may be in the image, so near along its axis."""
    if not placed:
        return []
    seen = (middles - view.eye) @ view.pixel_from_ned.T
    depth = seen[:, 2]
    near = np.maximum(depth - radii, 1e-3)
    reach = 2.0 * view.focal_px * radii / near
    safe = np.maximum(depth, 1e-3)
    across = np.abs(seen[:, 0] / safe - view.width / 2) < view.width / 2 + reach
    along = np.abs(seen[:, 1] / safe - view.height / 2) < view.height / 2 + reach
    within = (depth > NEAR_M - radii) & (depth <= within_m + radii)
    kept = within & ((depth <= 1.5 * radii) | (across & along))
    return [placed[index] for index in np.flatnonzero(kept)]


def _clipped(
    corners: Matrix, shape: Shape, facing: NDArray[np.bool_]
) -> tuple[Matrix, list[int], NDArray[np.bool_]]:
    """Projected corners of the faces towards the eye, clipped at the near plane."""
    forward = np.array([0.0, 0.0, 1.0])
    pieces: list[Matrix] = []
    first = [0]
    kept = facing.copy()
    nearest = np.minimum.reduceat(corners[:, 2], shape.first[:-1])
    for face in range(len(shape.normals)):
        piece = np.zeros((0, 3))
        if facing[face]:
            piece = corners[shape.first[face] : shape.first[face + 1]]
            if nearest[face] < NEAR_M:
                piece = clip_polygon(piece, forward, NEAR_M)
        kept[face] = len(piece) >= 3
        if kept[face]:
            pieces.append(piece)
        first.append(first[-1] + (len(piece) if kept[face] else 0))
    if not pieces:
        return np.zeros((0, 2)), first, kept
    joined = np.concatenate(pieces)
    return joined[:, :2] / joined[:, 2:], first, kept


def _inside_share(points: Matrix, view: View) -> float:
    """Share of the area of the points' convex outline that lies inside the image."""
    bounded = np.clip(points, -FAR_PX, FAR_PX).astype(np.float32)
    outline = cv2.convexHull(bounded).reshape(-1, 2)
    whole = float(cv2.contourArea(outline))
    if whole < 1.0:
        return 1.0
    cut = outline.astype(np.float64)
    edges = (((1, 0), 0.0), ((-1, 0), 1.0 - view.width), ((0, 1), 0.0), ((0, -1), 1.0 - view.height))
    for normal, offset in edges:
        if len(cut) >= 3:
            cut = clip_polygon(cut, np.array(normal, np.float64), offset)
    if len(cut) < 3:
        return 0.0
    return min(1.0, float(cv2.contourArea(cut.astype(np.float32))) / whole)
