"""The companion's half of a real flight, flown again: every difference to PX4's answers is a known one."""

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from tools.recorded_flight import Difference, Flight, Received, compare, deviations, fly_again, read_flight

DATA = Path(os.environ.get("COMPANION_TEST_DATA", Path(__file__).parents[2] / "../shared/data"))
RECORDING = DATA / "px4" / "px4_sih_offboard_flight.tlog"
PAGE = Path(__file__).parents[2] / "docs" / "simulator-differences.md"


@pytest.fixture(scope="module")
def flight() -> Flight:
    if not RECORDING.exists():
        pytest.skip(f"needs the recorded flight {RECORDING}")
    return read_flight(RECORDING)


@pytest.fixture(scope="module")
def ours(flight: Flight) -> list[Received]:
    return fly_again(flight)


@pytest.fixture(scope="module")
def exact(flight: Flight) -> list[Received]:
    """Without sensor errors: of two flights each has its own, and neither says how an airframe moves."""
    return fly_again(flight, noise=0.0)


@pytest.fixture(scope="module")
def differences(flight: Flight, ours: list[Received]) -> list[Difference]:
    return compare(flight.received, ours)


def known() -> list[str]:
    """The keys in the first column of the page's list."""
    table = PAGE.read_text(encoding="utf-8").split("## The list")[1]
    return [
        key
        for line in table.splitlines()
        if line.startswith("| `")
        for key in re.findall(r"`([^`]+)`", line.split("|")[1])
    ]


def test_every_difference_is_on_the_page_by_its_own_name(differences: list[Difference]) -> None:
    listed = known()
    assert len(listed) > 40
    assert not [key for key in listed if "*" in key]  # a pattern would hide new differences
    new = [f"{found.key}: {found.found}" for found in differences if found.key not in listed]
    assert not new, "\n".join(new)


def test_every_line_of_the_page_is_still_a_difference(differences: list[Difference]) -> None:
    listed = known()
    assert len(set(listed)) == len(listed)
    found = {difference.key for difference in differences}
    stale = [key for key in listed if key not in found]
    assert not stale, f"no difference any more, take them off {PAGE.name}: {stale}"


def test_the_figures_on_the_page_are_those_measured(flight: Flight, exact: list[Received]) -> None:
    page = PAGE.read_text(encoding="utf-8")
    sent = {
        name: (float(rms), float(maximum), unit)
        for name, rms, unit, maximum in re.findall(
            r"^\| ([a-z ]+) \| ([\d.]+) (\S+) \| ([\d.]+) \3 \|$", page, re.MULTILINE
        )
    }
    measured = deviations(flight.received, exact)
    assert list(sent) == [deviation.quantity for deviation in measured]
    for deviation in measured:
        rms, maximum, unit = sent[deviation.quantity]
        assert unit == deviation.unit
        assert rms == pytest.approx(deviation.rms, rel=0.05, abs=0.01), deviation
        assert maximum == pytest.approx(deviation.maximum, rel=0.05, abs=0.01), deviation


@pytest.mark.parametrize(
    "kind", ["COMMAND_ACK", "COMMAND_LONG", "STATUSTEXT", "HEARTBEAT", "CURRENT_MODE", "EXTENDED_SYS_STATE"]
)
def test_what_happens_in_which_order_is_the_same(differences: list[Difference], kind: str) -> None:
    keys = [difference.key for difference in differences]
    assert not [key for key in keys if key.startswith(kind) and key.endswith("sequence")]


def test_the_trajectories_stay_together(flight: Flight, exact: list[Received]) -> None:
    apart = {deviation.quantity: deviation for deviation in deviations(flight.received, exact)}
    assert apart["horizontal position"].rms < 1.0
    assert apart["height"].rms < 0.5
    assert apart["yaw"].rms < 0.2


def thinned(messages: list[Received], steps: dict[str, int]) -> list[Received]:
    """Of each kind in `steps` the first of so many messages, in their order; no other kinds."""
    numbers = dict.fromkeys(steps, -1)
    kept = []
    for message in messages:
        if message.kind in steps:
            numbers[message.kind] += 1
            if numbers[message.kind] % steps[message.kind] == 0:
                kept.append(message)
    return kept


# A fifth of the streams is enough.
STEPS = {"ATTITUDE": 5, "VFR_HUD": 5, "LOCAL_POSITION_NED": 5, "COMMAND_ACK": 1, "EXTENDED_SYS_STATE": 1}


def test_the_same_flight_has_no_differences(flight: Flight) -> None:
    few = thinned(flight.received, STEPS)
    assert len(few) > 100
    assert compare(few, few) == []


def test_each_kind_of_difference_is_seen(ours: list[Received]) -> None:
    few = thinned(ours, STEPS)

    def keys(changed: list[Received]) -> set[str]:
        return {difference.key for difference in compare(few, changed)}

    assert "ATTITUDE missing" not in keys(few)
    assert "VFR_HUD missing" in keys([received for received in few if received.kind != "VFR_HUD"])
    acknowledged = [received for received in few if received.kind == "COMMAND_ACK"]
    refused = replace(acknowledged[0], fields=acknowledged[0].fields | {"result": 4})
    assert "COMMAND_ACK sequence" in keys(
        [refused if received is acknowledged[0] else received for received in few]
    )
    later = [replace(h, time_s=h.time_s + 5.0) if h.kind == "EXTENDED_SYS_STATE" else h for h in few]
    assert "EXTENDED_SYS_STATE landed_state times" in keys(later)
    tilted = [
        replace(h, fields=h.fields | {"vtol_state": 3}) if h.kind == "EXTENDED_SYS_STATE" else h for h in few
    ]
    assert "EXTENDED_SYS_STATE.vtol_state value" in keys(tilted)
    assert "ATTITUDE rate" in keys(thinned(few, dict.fromkeys(STEPS, 1) | {"ATTITUDE": 2}))
    assert "signed" in keys([replace(h, signed=True) for h in few])
