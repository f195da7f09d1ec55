"""Association after an occlusion, with switched track ids and a similar object nearby."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.guidance.objects.in_view import CHOOSING_S, Choice, ObjectsInView
from companion.guidance.objects.table import DOUBT_S, ObjectTable
from companion.guidance.objects.target import RangeSource, Target
from companion.guidance.objects.tracked_object import Subject, TrackedObject
from tests.companion.guidance.guidance_harness import known
from tests.companion.guidance.one_object import T0, OneObject, seen_car

SPEED_MPS, BEHIND_M, FRAME_S = 3.0, 8.0, 0.1


def seen(
    position: tuple[float, float], vehicle: tuple[float, float, float], seconds: float, identity: int
) -> Target:
    return seen_car(
        position, seconds / FRAME_S, vehicle=vehicle,
        confidence=0.9, track_id=identity, track_score=0.9, range_sigma_m=math.nan,
    )  # fmt: skip


class Road:
    """A car driving north with the vehicle behind it. `see` adds detections relative to the car."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.track = OneObject(seen(self.car, self.vehicle, 0.0, 1), self.vehicle)

    @property
    def car(self) -> tuple[float, float]:
        return (BEHIND_M + SPEED_MPS * self.seconds, 0.0)

    @property
    def vehicle(self) -> tuple[float, float, float]:
        return (SPEED_MPS * self.seconds, 0.0, -4.0)

    def see(self, for_s: float, **beside: tuple[float, float]) -> None:
        """`id1=(2.0, 0.0)`: track id 1, 2 m ahead of the car."""
        for _ in range(round(for_s / FRAME_S)):
            self.seconds += FRAME_S
            self.track.update(
                [
                    seen((self.car[0] + north, self.car[1] + east), self.vehicle, self.seconds, int(name[2:]))
                    for name, (north, east) in beside.items()
                ],
                self.vehicle,
                T0 + round(self.seconds * 1e9),
            )

    @property
    def off_m(self) -> float:
        return math.dist(self.track.now.position_at(T0 + round(self.seconds * 1e9))[:2], self.car)


@pytest.fixture
def road() -> Road:
    road = Road()
    road.see(5.0, id1=(0.0, 0.0))
    assert road.off_m < 0.3
    return road


def test_track_switches_back_when_the_object_reappears(road: Road) -> None:
    road.see(1.8)
    road.see(0.3, id1=(-0.5, 2.4))  # a similar object with its id
    assert road.off_m > 1.0
    road.see(1.0, id1=(-0.5, 2.4), id37=(0.2, 0.1))
    assert road.track.track_id == 37
    assert road.off_m < 0.5


def test_object_is_found_again_with_its_own_id(road: Road) -> None:
    road.see(1.5)
    road.see(0.1, id1=(1.0, 2.2))
    road.see(0.2)
    road.see(1.0, id1=(0.0, 0.2))
    assert road.off_m < 0.5


def test_off_path_reappearance_is_kept_without_a_rival(road: Road) -> None:
    road.see(1.5)
    road.see(1.0, id5=(0.3, 1.5), id6=(9.0, 7.0))
    assert road.track.track_id == 5
    assert road.off_m == pytest.approx(1.5, abs=0.4)


def test_hypothesis_expires(road: Road) -> None:
    road.see(1.5)
    road.see(DOUBT_S + 0.5, id5=(0.0, 2.0))
    road.see(1.0, id5=(0.0, 2.0), id6=(0.0, 0.0))
    assert road.track.track_id == 5


def test_returning_id_far_from_prediction_is_rejected(road: Road) -> None:
    road.see(1.3)
    road.see(0.5, id1=(0.5, -3.9))
    assert road.off_m < 0.5


@pytest.mark.parametrize("turn_deg", [90.0, -90.0, 180.0])
def test_own_id_without_a_rival_is_followed_in_a_turn(road: Road, turn_deg: float) -> None:
    corner, turn = road.car, math.radians(turn_deg)

    def car(seconds: float) -> tuple[float, float]:
        return (
            corner[0] + SPEED_MPS * seconds * math.cos(turn),
            corner[1] + SPEED_MPS * seconds * math.sin(turn),
        )

    for index in range(1, 31):
        road.seconds += FRAME_S
        road.track.update([seen(car(FRAME_S * index), (*corner, -4.0), road.seconds, 1)], (*corner, -4.0))
    now_ns = T0 + round(road.seconds * 1e9)
    assert road.track.now.last_ns == now_ns
    assert math.dist(road.track.now.position_at(now_ns)[:2], car(3.0)) < 0.5
    assert (
        math.dist(road.track.now.velocity_ned_mps, (SPEED_MPS * math.cos(turn), SPEED_MPS * math.sin(turn)))
        < 0.6
    )


def test_own_id_far_off_is_refused_beside_a_rival(road: Road) -> None:
    road.see(1.0, id1=(-4.0, 4.0), id37=(0.0, 0.0))
    assert road.track.track_id == 37
    assert road.off_m < 0.3


def test_single_wrong_ranges_do_not_restart_the_filter(road: Road) -> None:
    for _ in range(10):
        road.see(0.2, id1=(6.0, 0.0))
        assert road.off_m < 0.5
        road.see(0.3, id1=(0.0, 0.0))
    assert road.off_m < 0.3


def test_short_gap_at_the_prediction_is_no_occlusion(road: Road) -> None:
    road.see(0.4)
    road.see(0.4, id1=(0.0, 0.0))
    # It turns, and a similar object comes to the predicted position.
    for step in range(12):
        road.see(FRAME_S, id1=(0.0, 0.02 * step**2), id9=(0.0, -0.3))
    assert road.track.track_id == 1


def test_own_id_is_associated_without_a_range(road: Road) -> None:
    road.see(0.7)
    for doubted in (False, True):
        road.seconds += FRAME_S
        target = seen(road.car, road.vehicle, road.seconds, 1)
        target = (
            replace(target, trusted=False)
            if doubted
            else replace(target, position_ned_m=None, ground_range_m=math.nan, range_source=RangeSource.NONE)
        )
        assert road.track.update([target], road.vehicle)


def test_slow_detector_is_no_occlusion() -> None:
    road = Road()
    for _ in range(12):
        road.see(FRAME_S, id1=(0.0, 0.0), id2=(0.0, 4.0))
        road.seconds += 0.6
    for _ in range(6):
        road.see(FRAME_S, id1=(0.0, 0.0), id3=(0.5, 1.0))
        road.seconds += 0.6
        assert road.off_m < 0.7
    assert road.track.track_id == 1


def test_changed_range_source_widens_the_gate(road: Road) -> None:
    taken = 0
    for _ in range(10):
        road.seconds += FRAME_S
        nearer = seen((road.car[0] - 2.0, 0.0), road.vehicle, road.seconds, 1)
        taken += road.track.update([replace(nearer, range_source=RangeSource.KNOWN_HEIGHT)], road.vehicle)
    assert taken >= 7
    assert road.off_m == pytest.approx(2.0, abs=0.7)


def choose(frames: list[list[Target]]) -> TrackedObject | Target | None:
    """The car that is chosen by the last frame, nose to the north; without a range its detection."""
    table, found = ObjectTable(), None
    choices: dict[Subject, Choice] = {}
    for index, targets in enumerate(frames):
        now_ns = T0 + round((index + 1) * FRAME_S * 1e9)
        stamped = [replace(target, captured_ns=now_ns) for target in targets]
        objects = table.update(stamped, (0.0, 0.0, -4.0), now_ns)
        in_view = ObjectsInView(objects, now_ns=now_ns, _choices=choices)
        found = in_view.of(Subject("car")) or in_view.in_sight(Subject("car"))
    return found


def test_often_ambiguous_object_is_not_chosen() -> None:
    def chosen(doubts: str) -> TrackedObject | Target | None:
        car = seen((20.0, 0.0), (0.0, 0.0, -4.0), 0.0, 3)
        return choose([[replace(car, trusted=doubt != "?")] for doubt in doubts])

    assert chosen("?????.?????????") is None
    assert chosen("??.........") is not None
    assert chosen("??..?......") is not None


def test_without_ranges_the_smallest_angle_is_chosen() -> None:
    aside = Target("car", 0.9, 1, math.radians(9.5), -0.3, track_id=1)
    ahead = replace(aside, bearing_rad=math.radians(0.2), track_id=2)
    found = choose([[aside, ahead]] * 8)
    assert found is not None
    assert (found.track_id, found.position_ned_m) == (2, None)


def test_nearest_object_ahead_is_chosen() -> None:
    def chosen(*positions: tuple[float, float]) -> tuple[float, ...]:
        targets = [seen(place, (0.0, 0.0, -4.0), 0.0, index) for index, place in enumerate(positions)]
        found = choose([targets] * (round(CHOOSING_S / FRAME_S) + 2))
        assert found is not None
        return tuple(round(value, 3) for value in known(found.position_ned_m)[:2])

    assert chosen((56.0, 1.0), (10.0, 0.9)) == (10.0, 0.9)
    # Away from the nose only the direction counts.
    assert chosen((30.0, 1.0), (5.0, 5.0)) == (30.0, 1.0)
    assert chosen((5.0, 5.0), (30.0, 12.0)) == (30.0, 12.0)


WHOLE, ASIDE = (300.0, 200.0, 400.0, 250.0), (0.0, 225.0, 140.0, 290.0)
Box = tuple[float, float, float, float]


@pytest.mark.parametrize(
    ("shown", "nearer", "for_s", "missed_every"),
    [
        pytest.param((300.0, 200.0, 400.0, 230.0), (280.0, 225.0, 420.0, 290.0), 1.0, 99, id="below"),
        pytest.param((300.0, 200.0, 400.0, 224.0), (280.0, 226.0, 420.0, 290.0), 1.0, 99, id="gap"),
        pytest.param((300.0, 200.0, 380.0, 250.0), (350.0, 195.0, 480.0, 290.0), 1.0, 99, id="side"),
        pytest.param((300.0, 200.0, 400.0, 230.0), (280.0, 225.0, 420.0, 290.0), 1.0, 3, id="missed"),
        pytest.param((300.0, 200.0, 400.0, 230.0), (280.0, 225.0, 420.0, 290.0), 4.0, 99, id="long"),
    ],
)
def test_hidden_edge_leaves_the_object_on_its_way(
    shown: Box, nearer: Box, for_s: float, missed_every: int
) -> None:
    """Its box ends where a nearer one begins: the range by the ground is too long by 4 m."""
    table, vehicle = ObjectTable(), (0.0, 0.0, -3.0)
    for frame in range(round((2.5 + for_s) / FRAME_S)):
        seconds = frame * FRAME_S
        hidden = seconds > 2.5
        car = (12.0, SPEED_MPS * (seconds - 2.0))
        far = replace(seen(car, vehicle, seconds, 1), elevation_rad=-0.2, box_xyxy=shown if hidden else WHOLE)
        near = replace(seen((8.0, car[1]), vehicle, seconds, 2), box_xyxy=nearer if hidden else ASIDE)
        if hidden:
            share = 1.0 + 4.0 / far.ground_range_m
            far = replace(far, position_ned_m=(car[0] * share, car[1] * share, 0.0))
        targets = [far] if hidden and frame % missed_every == 0 else [far, near]
        table.update(targets, vehicle, far.captured_ns)
        known = table.of_track(1)
        assert known is not None
        assert known.position_ned_m is not None
        assert not known.occluded
        if seconds > 2.0:
            assert math.dist(known.position_ned_m[:2], car) < 0.7


def test_reach_counts_from_when_it_was_seen_whole() -> None:
    """It turned while a part of it was hidden, and comes back with its id."""
    table, vehicle = ObjectTable(), (0.0, 0.0, -3.0)
    for frame in range(44):
        seconds = frame * FRAME_S
        hidden = 1.5 < seconds < 3.0
        near = replace(seen((8.0, 0.0), vehicle, seconds, 2), box_xyxy=(280.0, 225.0, 420.0, 290.0))
        far = seen((12.0, 3.8 if seconds > 4.0 else 0.0), vehicle, seconds, 1)
        far = replace(far, elevation_rad=-0.2, box_xyxy=(300.0, 200.0, 400.0, 230.0 if hidden else 220.0))
        table.update([near] if 3.0 <= seconds <= 4.0 else [far, near], vehicle, near.captured_ns)
    [far_object, _] = table.objects
    assert far_object.track_ids == (1,)
    assert not far_object.occluded
