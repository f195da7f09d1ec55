"""Places the labels of boxes in an image: no label covers another one."""

from __future__ import annotations

from collections.abc import Sequence

Rectangle = tuple[int, int, int, int]
"""Left, top, right, bottom in pixels; the last two outside."""
MOST_LABELS = 60
"""In one image: the search for a free place grows with their number squared."""


def place_label(
    box: Rectangle, size: tuple[int, int], image_size: tuple[int, int], occupied: Sequence[Rectangle]
) -> Rectangle | None:
    """Return where to draw the label of a box, near it and clear of what is occupied; None: no space is left.

    Above the box, inside, below, and else the nearest free place. One that covers a small box is chosen
    last of those.

    Args:
        size, image_size: width and height, pixels. occupied: by earlier labels, and what else to keep clear.
    """
    (width, height), (image_width, image_height) = size, image_size
    if width > image_width or height > image_height or len(occupied) >= MOST_LABELS:
        return None
    box_left, box_top, box_right, box_bottom = box
    left = min(max(box_left - 1, 0), image_width - width)
    end = min(max(box_right - width + 1, 0), image_width - width)
    tops = (
        box_top - height,
        box_top,
        box_bottom,
        box_bottom - height,
        box_top - 2 * height,
        box_bottom + height,
    )
    small = (box_right - box_left) * (box_bottom - box_top) < 3 * width * height
    near = [_at(x, y, size) for y in tops for x in (left, end) if 0 <= y <= image_height - height]
    if free := [place for place in near if not any(_overlap(place, other) for other in occupied)]:
        return min(free, key=lambda place: _overlap(place, box) if small else 0)
    # A free place can be moved left and up until it touches something: if there is one, one is among these.
    wanted_top = min(max(box_top - height, 0), image_height - height)
    columns = sorted({0, left, *(other[2] for other in occupied)}, key=lambda x: abs(x - left))
    rows = sorted({0, wanted_top, *(other[3] for other in occupied)}, key=lambda y: abs(y - wanted_top))
    best, nearest = None, float("inf")
    for y in rows:
        for x in columns:
            away = abs(x - left) + abs(y - wanted_top)
            if away >= nearest:
                break
            if not (0 <= x <= image_width - width and 0 <= y <= image_height - height):
                continue
            place = _at(x, y, size)
            if not any(_overlap(place, other) for other in occupied):
                best, nearest = place, away
    return best


def _at(x: int, y: int, size: tuple[int, int]) -> Rectangle:
    return x, y, x + size[0], y + size[1]


def _overlap(one: Rectangle, other: Rectangle) -> int:
    across = min(one[2], other[2]) - max(one[0], other[0])
    down = min(one[3], other[3]) - max(one[1], other[1])
    return max(across, 0) * max(down, 0)
