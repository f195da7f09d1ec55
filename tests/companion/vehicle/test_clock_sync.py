"""The autopilot's clock, estimated from TIMESYNC replies."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.vehicle.clock_sync import KEPT_S, LONGEST_TRIP_NS, ClockOffset, ClockSync

MS = 1_000_000
SECOND = 1_000_000_000


def asked(sync: ClockSync, at_ns: int, there_ns: int, back_ns: int, offset_ns: int) -> bool:
    """Add a reply to a request sent at `at_ns` with these one-way delays."""
    return sync.answer(at_ns, at_ns + there_ns + offset_ns, at_ns + there_ns + back_ns)


@given(
    st.integers(-(10**15), 10**15),
    st.lists(st.tuples(st.integers(0, 45 * MS), st.integers(0, 45 * MS)), min_size=1, max_size=18),
    st.floats(-50e-6, 50e-6),
)
def test_true_offset_is_within_the_reported_error(
    offset_ns: int, trips: list[tuple[int, int]], drift: float
) -> None:
    sync, at_ns = ClockSync(), SECOND
    for there_ns, back_ns in trips:
        true_ns = offset_ns + round(at_ns * drift)
        assert asked(sync, at_ns, there_ns, back_ns, true_ns)
        at_ns += SECOND // 2
    known = sync.offset(at_ns)
    assert known is not None
    assert abs(known.offset_ns - (offset_ns + at_ns * drift)) <= known.error_ns + 1000
    assert known.error_ns <= min(sum(trip) for trip in trips) / 2 + KEPT_S * 1e9 * 100e-6 + 1


def test_shortest_round_trip_wins() -> None:
    sync = ClockSync()
    asked(sync, SECOND, 200_000, 200_000, 7 * SECOND)
    asked(sync, 2 * SECOND, 1 * MS, 80 * MS, 7 * SECOND)
    known = sync.offset(2 * SECOND)
    assert known is not None
    assert known == ClockOffset(7 * SECOND, 200_000 + 99_960) or known.offset_ns == 7 * SECOND
    assert not asked(sync, 3 * SECOND, 1 * MS, LONGEST_TRIP_NS, 7 * SECOND)
    assert not sync.answer(5 * SECOND, 1, 4 * SECOND)


def test_offset_error_grows_and_expires() -> None:
    sync = ClockSync()
    assert sync.offset(SECOND) is None
    asked(sync, SECOND, MS, MS, 5)
    young, old = sync.offset(2 * SECOND), sync.offset(9 * SECOND)
    assert young is not None
    assert old is not None
    assert young.error_ns < old.error_ns
    assert sync.offset(SECOND + round((KEPT_S + 1) * 1e9)) is None


@pytest.mark.parametrize("jump_ns", [-3600 * SECOND, -200 * MS, 200 * MS, 3600 * SECOND])
def test_clock_jump_is_adopted_at_the_next_reply(jump_ns: int) -> None:
    sync, at_ns = ClockSync(), 10_000 * SECOND
    for step in range(5):
        asked(sync, at_ns + step * SECOND, 2 * MS, 3 * MS, 4 * SECOND)
    asked(sync, at_ns + 5 * SECOND, 2 * MS, 3 * MS, 4 * SECOND + jump_ns)
    known = sync.offset(at_ns + 5 * SECOND)
    assert known is not None
    assert abs(known.offset_ns - 4 * SECOND - jump_ns) <= known.error_ns


def test_stamp_falls_back_to_the_arrival() -> None:
    sync, now_ns = ClockSync(), 50 * SECOND
    assert sync.stamp(1_000, now_ns) == now_ns
    asked(sync, now_ns, MS, MS, -40 * SECOND)  # booted at 40 s
    late_ns = 30 * MS
    boot_ms = (now_ns - 40 * SECOND) // MS
    assert abs(sync.stamp(boot_ms, now_ns + late_ns) - now_ns) <= MS
    # In the future: clamped to the arrival within the error, another clock beyond it.
    assert sync.stamp(boot_ms + 1, now_ns + MS) <= now_ns + MS
    assert sync.stamp(boot_ms + 5_000, now_ns) == now_ns
    assert sync.offset(now_ns) is None


def test_stamps_of_jittered_messages_are_restored() -> None:
    rng, sync = random.Random(4), ClockSync()
    offset_ns, worst_ns = -123 * SECOND - 456_789, 0
    for step in range(400):
        true_ns = 500 * SECOND + step * 20 * MS
        if step % 25 == 0:
            asked(sync, true_ns, rng.randrange(MS, 30 * MS), rng.randrange(MS, 30 * MS), offset_ns)
        arrived_ns = true_ns + 35 * MS + rng.randrange(60 * MS)
        stamp_ns = sync.stamp((true_ns + offset_ns) // MS, arrived_ns)
        known = sync.offset(arrived_ns)
        assert known is not None
        assert abs(stamp_ns - true_ns) <= known.error_ns + MS
        worst_ns = max(worst_ns, abs(stamp_ns - true_ns))
    assert worst_ns < 35 * MS  # the arrivals are off by up to 95 ms
