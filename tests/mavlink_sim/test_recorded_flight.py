"""The companion's half of a real flight, flown again: every difference to PX4's answers is a known one."""

import os
import re
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from mavlink_sim.recorded_flight import Difference, Flight, Heard, compare, deviations, fly_again, read_flight

DATA = Path(os.environ.get("COMPANION_TEST_DATA", Path(__file__).parents[2] / "../shared/data"))
RECORDING = DATA / "px4" / "px4_sih_offboard_flight.tlog"
PAGE = Path(__file__).parents[2] / "docs" / "simulator-differences.md"


@pytest.fixture(scope="module")
def flight() -> Flight:
    if not RECORDING.exists():
        pytest.skip(f"needs the recorded flight {RECORDING}")
    return read_flight(RECORDING)


@pytest.fixture(scope="module")
def ours(flight: Flight) -> list[Heard]:
    return fly_again(flight)


@pytest.fixture(scope="module")
def differences(flight: Flight, ours: list[Heard]) -> list[Difference]:
    return compare(flight.heard, ours)


def known() -> list[str]:
    """The patterns in the first column of the page's list."""
    table = PAGE.read_text(encoding="utf-8").split("## The list")[1]
    return [
        pattern
        for line in table.splitlines()
        if line.startswith("| `")
        for pattern in re.findall(r"`([^`]+)`", line.split("|")[1])
    ]


def test_every_difference_is_on_the_page(differences: list[Difference]) -> None:
    patterns = known()
    assert len(patterns) > 10
    new = [
        f"{difference.key}: {difference.found}"
        for difference in differences
        if not any(fnmatchcase(difference.key, pattern) for pattern in patterns)
    ]
    assert not new, "\n".join(new)


@pytest.mark.parametrize(
    "kind", ["COMMAND_ACK", "COMMAND_LONG", "STATUSTEXT", "HEARTBEAT", "CURRENT_MODE", "EXTENDED_SYS_STATE"]
)
def test_what_happens_in_which_order_is_the_same(differences: list[Difference], kind: str) -> None:
    keys = [difference.key for difference in differences]
    assert not [key for key in keys if key.startswith(kind) and key.endswith("sequence")]


def test_the_trajectories_stay_together(flight: Flight, ours: list[Heard]) -> None:
    apart = {deviation.quantity: deviation for deviation in deviations(flight.heard, ours)}
    assert apart["horizontal position"].rms < 1.5
    assert apart["height"].rms < 0.5
    assert apart["yaw"].rms < 0.2


def test_the_same_flight_has_no_differences(flight: Flight) -> None:
    assert compare(flight.heard, flight.heard) == []


def test_each_kind_of_difference_is_seen(ours: list[Heard]) -> None:
    few = {"ATTITUDE", "VFR_HUD", "COMMAND_ACK", "EXTENDED_SYS_STATE", "LOCAL_POSITION_NED"}
    ours = [heard for heard in ours if heard.kind in few]

    def keys(changed: list[Heard]) -> set[str]:
        return {difference.key for difference in compare(ours, changed)}

    assert "ATTITUDE missing" not in keys(ours)
    assert "VFR_HUD missing" in keys([heard for heard in ours if heard.kind != "VFR_HUD"])
    acknowledged = [heard for heard in ours if heard.kind == "COMMAND_ACK"]
    refused = replace(acknowledged[0], fields=acknowledged[0].fields | {"result": 4})
    assert "COMMAND_ACK sequence" in keys([refused if heard is acknowledged[0] else heard for heard in ours])
    later = [replace(h, time_s=h.time_s + 5.0) if h.kind == "EXTENDED_SYS_STATE" else h for h in ours]
    assert "EXTENDED_SYS_STATE landed_state times" in keys(later)
    tilted = [
        replace(h, fields=h.fields | {"vtol_state": 3}) if h.kind == "EXTENDED_SYS_STATE" else h for h in ours
    ]
    assert "EXTENDED_SYS_STATE.vtol_state value" in keys(tilted)
    thinned = [h for n, h in enumerate(ours) if h.kind != "ATTITUDE" or n % 2]
    assert "ATTITUDE rate" in keys(thinned)
    assert "signed" in keys([replace(h, signed=True) for h in ours])


def test_a_file_without_a_flight_says_so(tmp_path: Path) -> None:
    (tmp_path / "empty.tlog").write_bytes(b"")
    with pytest.raises(ValueError, match=r"empty\.tlog is no recorded flight"):
        read_flight(tmp_path / "empty.tlog")
