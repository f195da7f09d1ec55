"""The behaviour of PX4's releases where they differ."""

import pytest

from mavlink_sim import LockstepVehicle
from mavlink_sim.releases import RELEASES, release_named
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness


@pytest.mark.parametrize("release", ["1.14", "1.15"])
def test_older_release_answers_mode_request_once(make_harness: type[SimHarness], release: str) -> None:
    harness = make_harness(px4=release)
    harness.take_off()
    assert harness.set_mode(6) == [1]
    assert harness.set_mode(4, 5) == [0]


@pytest.mark.parametrize("release", ["1.16", "1.17"])
def test_a_newer_release_answers_it_twice(make_harness: type[SimHarness], release: str) -> None:
    harness = make_harness(px4=release)
    harness.take_off()
    assert harness.set_mode(6) == [0, 1]


@pytest.mark.parametrize(("release", "answers"), [("1.16", 0), ("1.17", 1)])
def test_parameter_errors_since_v1_17_only(
    make_harness: type[SimHarness], release: str, answers: int
) -> None:
    harness = make_harness(px4=release)
    for request in (
        dialect.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1),
        dialect.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 1.0, 6),
    ):
        harness.forget()
        harness.send(request)
        harness.fly(0.05)
        assert harness.received("PARAM_VALUE") == []
        assert len(harness.received("PARAM_ERROR")) == answers


@pytest.mark.parametrize("release", RELEASES)
def test_reported_version_is_the_releases(make_harness: type[SimHarness], release: str) -> None:
    harness = make_harness(px4=release)
    harness.fly(0.1)
    harness.command(512, 148)
    version = harness.received("AUTOPILOT_VERSION")[0].flight_sw_version
    assert f"{version >> 24}.{version >> 16 & 0xFF}" == release


def test_unknown_release_refused() -> None:
    with pytest.raises(ValueError, match=r"'2\.0'.*1\.14, 1\.15, 1\.16, 1\.17"):
        release_named("2.0")


def test_an_ardupilot_vehicle_in_lockstep_has_no_release_of_px4() -> None:
    with pytest.raises(ValueError, match=r"px4 .1\.14."):
        LockstepVehicle(autopilot="ardupilot", px4="1.14")
