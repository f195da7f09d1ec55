"""Whatever arrives, the vehicle flies on and keeps its time: short, seeded runs of the fuzzer."""

import itertools

import pytest

from mavlink_sim.wire.messages import parser
from tools.fuzz_simulator import Fuzzer, SocketReport, Target, fuzz_in_lockstep, fuzz_over_sockets

TARGETS = [
    Target(),
    pytest.param(Target(gimbal=True), marks=pytest.mark.slow),
    Target("ardupilot"),
    Target(signed=True),
]
NAMES = ["px4", "gimbal", "ardupilot", "signed"]


@pytest.mark.parametrize("target", TARGETS, ids=NAMES)
@pytest.mark.parametrize("seed", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
def test_a_vehicle_in_lockstep_bears_mutated_mavlink(seed: int, target: Target) -> None:
    report = fuzz_in_lockstep(seed, 1500, target)
    assert report.messages > (300 if target.signed else 800)
    assert (report.refused > 300) is target.signed
    assert report.simulated_s == pytest.approx(6.0)


@pytest.mark.realtime
def test_a_running_vehicle_answers_its_client_through_a_flood() -> None:
    report = fuzz_over_sockets(seed=4, seconds=2.0, target=Target(gimbal=True))
    assert report.datagrams > 200
    assert report.answers > 0
    # Of one processor's time, whatever else this machine does: it never works its loop full. That it keeps
    # its time as well, `python -m tools.fuzz_simulator` measures on a quiet machine.
    assert report.load < 0.9


def test_a_vehicle_that_was_slowed_is_found_out() -> None:
    report = SocketReport(seed=1)
    assert report.kept_up
    report.said["cannot keep up"] += 1
    assert not report.kept_up
    assert "NOT KEEP" in report.text()


def test_the_same_seed_throws_the_same_bytes() -> None:
    one, two = (list(itertools.islice(Fuzzer(9).datagrams(), 500)) for _ in range(2))
    assert one == two
    assert one != list(itertools.islice(Fuzzer(10).datagrams(), 500))


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_most_frames_are_whole_and_every_handler_is_met(autopilot: str) -> None:
    fuzzer = Fuzzer(5, Target(autopilot))
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
    assert set(Target(autopilot).handlers) - {"SETUP_SIGNING"} <= met
