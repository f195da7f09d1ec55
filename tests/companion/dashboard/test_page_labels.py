"""The labels in the video, by the page's own function in node: as those of annotated images."""

from __future__ import annotations

import random

import pytest

from tests.companion.dashboard.page_module import evaluate
from tests.vision.test_labels import IMAGE, has_room, overlapping
from vision.labels import Rectangle

pytestmark = pytest.mark.needs("node")

PLACED = """
given.map(({ boxes, size, image }) => {
  const occupied = [];
  return boxes.map((box) => {
    const place = module.placeLabel(box, size, image, occupied);
    if (place) occupied.push(place);
    return place;
  });
})
"""


def test_no_label_in_the_video_covers_another() -> None:
    chance = random.Random(7)
    scenes = []
    for _ in range(150):
        count, size = chance.randint(1, 25), (chance.randint(3, 30), chance.randint(3, 12))
        boxes = []
        for _ in range(count):
            across = sorted(chance.randint(0, IMAGE[0] - 1) for _ in range(2))
            down = sorted(chance.randint(0, IMAGE[1] - 1) for _ in range(2))
            boxes.append([across[0], down[0], across[1], down[1]])
        scenes.append({"boxes": boxes, "size": size, "image": IMAGE})
    for scene, places in zip(scenes, evaluate("labels.js", PLACED, scenes), strict=True):
        placed: list[Rectangle] = []
        for place in places:
            if place is None:
                assert not has_room(scene["size"], placed)  # type: ignore[arg-type]
                continue
            assert not any(overlapping(tuple(place), other) for other in placed)
            assert min(place) >= 0
            assert place[2] <= IMAGE[0]
            assert place[3] <= IMAGE[1]
            placed.append(tuple(place))
