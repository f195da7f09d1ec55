"""The link stage adds nothing, counts every loss, and keeps the order without `Reorder`."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.wire.link_faults import (
    Channel,
    Corruption,
    Delay,
    Duplication,
    Impairment,
    Loss,
    RateLimit,
    Reorder,
)

share = st.floats(0.0, 1.0)
seeds = st.integers(0, 2**32)
in_order = (
    st.builds(Loss, share, seeds),
    st.builds(Delay, st.floats(0.0, 1.0), st.floats(0.0, 1.0), seeds),
    st.builds(RateLimit, st.floats(100.0, 1e6)),
)
unchanged = (
    *in_order,
    st.builds(Duplication, share, seeds),
    st.builds(Reorder, share, st.floats(0.01, 1.0), seeds),
)
KEEPING_ORDER = st.lists(st.one_of(*in_order), max_size=4)
KEEPING_BYTES = st.lists(st.one_of(*unchanged), max_size=5)
ANY = st.lists(st.one_of(*unchanged, st.builds(Corruption, share, seeds)), max_size=6)
# gaps between datagrams (seconds), their sizes
TRAFFIC = st.lists(st.tuples(st.floats(0.0, 0.2), st.integers(4, 300)), max_size=60)


def carry(
    impairments: list[Impairment], traffic: list[tuple[float, int]]
) -> tuple[Channel, list[bytes], list[tuple[float, bytes]]]:
    """Send traffic through a channel, polling at every input; returns inputs and outputs with times."""
    channel = Channel()
    for impairment in impairments:
        channel.impair(impairment)
    now_s, sent, got = 0.0, [], []
    for number, (gap_s, size) in enumerate(traffic):
        now_s += gap_s
        datagram = number.to_bytes(4, "big") + bytes(size - 4)
        sent.append(datagram)
        channel.push(now_s, datagram, number)
        got += [(now_s, data) for data, _ in channel.due(now_s)]
    got += [(now_s + 1000.0, data) for data, _ in channel.due(now_s + 1000.0)]
    return channel, sent, got


@given(ANY, TRAFFIC)
def test_every_datagram_is_delivered_lost_or_waiting(
    impairments: list[Impairment], traffic: list[tuple[float, int]]
) -> None:
    channel, sent, got = carry(impairments, traffic)
    counts = channel.counts
    assert counts.entered == len(sent)
    assert counts.delivered == len(got)
    assert counts.entered + counts.duplicated == counts.delivered + counts.lost + channel.waiting


@given(KEEPING_BYTES, TRAFFIC)
def test_no_datagram_is_invented(impairments: list[Impairment], traffic: list[tuple[float, int]]) -> None:
    channel, sent, got = carry(impairments, traffic)
    assert {data for _, data in got} <= set(sent)
    assert len(got) <= len(sent) + channel.counts.duplicated


@given(KEEPING_ORDER, TRAFFIC)
def test_without_reordering_the_order_is_kept(
    impairments: list[Impairment], traffic: list[tuple[float, int]]
) -> None:
    _, _, got = carry(impairments, traffic)
    numbers = [int.from_bytes(data[:4], "big") for _, data in got]
    assert numbers == sorted(numbers)


@given(ANY, TRAFFIC)
def test_nothing_arrives_before_it_was_sent(
    impairments: list[Impairment], traffic: list[tuple[float, int]]
) -> None:
    channel = Channel()
    for impairment in impairments:
        channel.impair(impairment)
    now_s = 0.0
    for gap_s, size in traffic:
        now_s += gap_s
        channel.push(now_s, bytes(size), now_s)
        assert all(sent_s <= now_s for _, sent_s in channel.due(now_s))


@given(share, seeds, TRAFFIC)
def test_corruption_changes_bytes_and_never_the_length(
    probability: float, seed: int, traffic: list[tuple[float, int]]
) -> None:
    channel, sent, got = carry([Corruption(probability, seed)], traffic)
    changed = 0
    for before, (_, after) in zip(sent, got, strict=True):
        assert len(before) == len(after)
        different = sum(a != b for a, b in zip(before, after, strict=True))
        assert different <= 4
        changed += different > 0
    assert changed == channel.counts.corrupted


@given(st.lists(st.sampled_from(["loss", "delay", "duplicate", "reorder", "corrupt"])), seeds, TRAFFIC)
def test_same_seed_gives_same_result(names: list[str], seed: int, traffic: list[tuple[float, int]]) -> None:
    def made() -> list[Impairment]:
        makers: dict[str, Callable[[], Impairment]] = {
            "loss": lambda: Loss(0.3, seed),
            "delay": lambda: Delay(0.1, 0.2, seed),
            "duplicate": lambda: Duplication(0.3, seed),
            "reorder": lambda: Reorder(0.3, 0.1, seed),
            "corrupt": lambda: Corruption(0.3, seed),
        }
        return [makers[name]() for name in names]

    assert carry(made(), traffic)[2] == carry(made(), traffic)[2]


def test_a_delay_is_exact_and_jitter_stays_within_its_bound() -> None:
    channel = Channel()
    channel.impair(Delay(0.2, 0.1, 7))
    for number in range(100):
        channel.push(number, b"x", number)
        assert not channel.due(number + 0.199)
        assert len(channel.due(number + 0.301)) == 1


def test_the_order_of_beginning_does_not_matter() -> None:
    traffic = [(0.01, 50)] * 200
    one = [Loss(0.2, 1), Delay(0.1, 0.05, 2), Corruption(0.1, 3)]
    other = [Corruption(0.1, 3), Delay(0.1, 0.05, 2), Loss(0.2, 1)]
    assert carry(one, traffic)[2] == carry(other, traffic)[2]


def test_end_of_delay_keeps_order() -> None:
    channel, delay = Channel(), Delay(1.0)
    channel.impair(delay)
    channel.push(0.0, b"first")
    channel.clear(delay)
    channel.push(0.1, b"second")
    assert not channel.due(0.5)
    assert [data for data, _ in channel.due(1.0)] == [b"first", b"second"]
    channel.push(2.0, b"third")
    assert [data for data, _ in channel.due(2.0)] == [b"third"]
    assert not channel.engaged


def test_reordering_lets_later_ones_come_first() -> None:
    channel, _, got = carry([Reorder(0.3, 0.05, 5)], [(0.01, 20)] * 300)
    numbers = [int.from_bytes(data[:4], "big") for _, data in got]
    assert sorted(numbers) == list(range(300))
    assert numbers != sorted(numbers)
    assert channel.counts.held_back == pytest.approx(90, abs=30)


def test_rate_limit_drops_beyond_buffer() -> None:
    channel = Channel()
    channel.impair(RateLimit(5760.0))
    carried = 0
    for step in range(2500):  # 10 s of 30 kB/s
        now_s = step * 0.004
        channel.push(now_s, bytes(120))
        carried += sum(len(data) for data, _ in channel.due(now_s))
    assert carried == pytest.approx(5760 * 10, rel=0.1)
    assert channel.counts.lost > 1500
    assert channel.waiting * 120 <= 4096


def test_rate_limit_below_capacity_loses_nothing() -> None:
    channel, sent, got = carry([RateLimit(10_000.0)], [(0.1, 100)] * 50)
    assert len(got) == len(sent)
    assert channel.counts.lost == 0


def test_datagrams_in_transit_can_be_dropped() -> None:
    channel = Channel()
    channel.impair(Delay(1.0))
    channel.push(0.0, b"x")
    channel.drop_waiting()
    assert channel.waiting == 0
    assert channel.counts.lost == 1
    assert channel.due(9.0) == []
