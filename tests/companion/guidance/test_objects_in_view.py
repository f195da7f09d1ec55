"""What a command's object is, and why there is none: `ObjectsInView`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.objects.in_view import CHOOSING_S, Choice, ObjectsInView
from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import DOUBTED, Target
from companion.guidance.objects.tracked_object import Subject
from tests.companion.guidance.guidance_harness import known
from tests.companion.guidance.one_object import seen_car

HERE = (0.0, 0.0, -4.0)
CAR, TRACK = Subject("car"), Subject(track_id=1)


def car(north: float, east: float = 0.0, track_id: int = 1, **more: Any) -> Target:
    sigmas = {"range_sigma_m": 0.2, "across_sigma_m": 0.1}
    seen = seen_car((north, east), vehicle=HERE, captured_ns=0, track_id=track_id)
    return replace(seen, **(sigmas | more))


class Scene:
    """A camera that is looked at ten times a second; `Subject` is chosen at each."""

    def __init__(self, subject: Subject) -> None:
        self.subject, self.now_ns = subject, 0
        self.table, self.choices = ObjectTable(), dict[Subject, Choice]()
        self.view = ObjectsInView()

    def show(self, seconds: float, *targets: Target, **more: Any) -> ObjectsInView:
        for _ in range(round(10 * seconds)):
            self.now_ns += 100_000_000
            stamped = [replace(target, captured_ns=self.now_ns) for target in targets]
            self.view = ObjectsInView(
                self.table.update(stamped, HERE, self.now_ns),
                now_ns=self.now_ns,
                here_ned_m=HERE,
                _choices=self.choices,
                **more,
            )
            self.view.of(self.subject)
        return self.view


@pytest.mark.parametrize(
    ("targets", "more", "words"),
    [
        ([], {}, ["did not find the car in 2.", "never seen"]),
        ([car(9.0, trusted=False)], {}, ["did not find", DOUBTED]),
        ([car(9.0, position_ned_m=None, ground_range_m=float("nan"))], {}, ["known range"]),
        ([], {"fault": "no detections received"}, ["did not find", "no detections received"]),
    ],
)
def test_reason_where_nothing_was_chosen(
    targets: list[Target], more: dict[str, Any], words: list[str]
) -> None:
    view = Scene(CAR).show(3.0, *targets, **more)
    assert view.of(CAR) is None
    why = known(view.lost(CAR, after_s=2.0))
    assert [word for word in words if word not in why] == []
    assert view.lost(CAR, after_s=5.0) is None


def test_reason_names_where_it_was_and_what_is_near() -> None:
    scene = Scene(TRACK)
    scene.show(2.0, car(9.0), car(9.0, 4.0, 2))
    assert scene.view.lost(TRACK, after_s=0.5) is None
    why = known(scene.show(3.0, car(9.0, 4.0, 2)).lost(TRACK, after_s=2.0))
    assert all(part in why for part in ("track 1 ", "3.0 s", "9.0 m", "track 2", "4.0 m"))
    why = known(scene.show(0.1, fault="camera frozen").lost(TRACK, after_s=2.0))
    assert why.endswith(": camera frozen")


def test_object_is_chosen_after_a_while_and_kept() -> None:
    scene = Scene(CAR)
    assert scene.show(CHOOSING_S, car(9.0), car(20.0, 1.0, 2)).of(CAR) is None
    chosen = known(scene.show(0.1, car(9.0), car(20.0, 1.0, 2)).of(CAR))
    assert chosen.track_id == 1
    kept = known(scene.show(15.0, car(20.0, 1.0, 2)).of(CAR))
    assert (kept.object_id, kept.occluded) == (chosen.object_id, True)


def test_object_without_a_range_gives_a_direction() -> None:
    scene, unranged = Scene(CAR), car(9.0, position_ned_m=None, ground_range_m=float("nan"))
    view = scene.show(1.0, unranged)
    assert view.of(CAR) is None
    target = known(view.in_sight(CAR))
    assert target.elevation_rad == unranged.elevation_rad
    assert scene.show(0.1, car(9.0)).of(CAR) is not None


def test_marker_of_another_camera_is_the_same_marker() -> None:
    """Each camera numbers its own objects."""
    marker = Subject(marker_id=7)
    first, other = (
        ObjectTable().update([car(10.0 + off, 0.0, track_id, class_name=name)], HERE, 0)
        for off, track_id, name in ((0.0, 7, "marker 7"), (2.0, 21, "marker 21"))
    )
    view = ObjectsInView(markers=first)
    view.choose(marker, first[0])
    [elsewhere] = ObjectTable().update([car(10.3, 0.0, 7, class_name="marker 7")], HERE, 0)
    both = (*other, replace(elsewhere, object_id=2))
    later = ObjectsInView(markers=both, _choices=view._choices)
    assert known(later.of(marker)) is both[1]
