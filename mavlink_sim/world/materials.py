"""Colours of objects (BGR, 0..255, without lighting), drawn from a seed."""

from __future__ import annotations

import colorsys
from functools import lru_cache

import numpy as np

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
