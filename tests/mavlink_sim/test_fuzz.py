"""Whatever arrives, the vehicle flies on and keeps its time: short, seeded runs of the fuzzer."""

import itertools

import pytest

from mavlink_sim.fuzz import Fuzzer, fuzz_in_lockstep, fuzz_over_sockets
from mavlink_sim.services.microservices import HANDLERS
from mavlink_sim.wire.messages import parser


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_vehicle_in_lockstep_bears_mutated_mavlink(seed: int) -> None:
    report = fuzz_in_lockstep(seed, 1500)
    assert report.messages > 800
    assert report.simulated_s == pytest.approx(6.0)


def test_a_running_vehicle_answers_its_client_through_a_flood() -> None:
    report = fuzz_over_sockets(seed=4, seconds=4.0)
    assert report.datagrams > 400
    assert report.answers > 0
    assert report.load < 0.9  # of one processor's time: it never works its loop full


def test_the_same_seed_throws_the_same_bytes() -> None:
    one, two = (list(itertools.islice(Fuzzer(9).datagrams(), 500)) for _ in range(2))
    assert one == two
    assert one != list(itertools.islice(Fuzzer(10).datagrams(), 500))


def test_most_frames_are_whole_and_every_handler_is_met() -> None:
    fuzzer = Fuzzer(5)
    reader = parser()
    met: set[str] = set()
    for datagram in itertools.islice(fuzzer.datagrams(), 6000):
        met |= {message.get_type() for message in reader.parse_buffer(datagram) or []}
    assert set(fuzzer.thrown) == {
        "frame",
        "bit flips",
        "truncated",
        "several",
        "random bytes",
        "old version",
        "burst",
    }
    assert set(HANDLERS) - {"SETUP_SIGNING"} <= met
