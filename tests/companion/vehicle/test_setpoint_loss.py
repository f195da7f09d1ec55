"""What the autopilot does without setpoints: function, simulated vehicle, and the table of the docs."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.bench.simulated_driver import RATES_HZ, SimulatedDriver
from companion.vehicle.autopilot_parameters import (
    NOTHING_READ,
    AutopilotParameters,
    FirmwareVersion,
    parameter_names,
)
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.setpoint_loss import (
    SetpointLossEffect,
    SetpointLossOutcome,
    setpoint_loss_outcome,
    without_service_text,
)
from companion.vehicle.state import FlightMode, VehicleState
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.px4.modes import Mode
from mavlink_sim.releases import RELEASES
from mavlink_sim.wire.messages import dialect

SAFETY = Path(__file__).parents[3] / "docs" / "safety.md"
PX4_DEFAULTS = {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 0.0, "NAV_RCL_ACT": 2.0}
COPTER_DEFAULTS = {"GUID_TIMEOUT": 3.0, "FS_GCS_ENABLE": 0.0, "FS_GCS_TIMEOUT": 5.0, "SYSID_MYGCS": 255.0}


def px4(version: str, **values: float) -> AutopilotParameters:
    numbers = [int(part) for part in version.split(".")]
    read = {**PX4_DEFAULTS, **values}
    return AutopilotParameters("PX4", FirmwareVersion(*numbers), 1, tuple(read.items()))


def outcome(version: str, *, sticks: bool = False, **values: float) -> SetpointLossOutcome:
    return setpoint_loss_outcome(px4(version, **values), sticks_present=sticks)


# --- flown with real autopilots -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "sticks", "values", "effect", "mode"),
    [
        ("1.14.4", False, {}, SetpointLossEffect.SINK, FlightMode.POSITION),
        ("1.16.2", False, {}, SetpointLossEffect.SINK, FlightMode.POSITION),
        ("1.16.2", False, {"COM_OBL_RC_ACT": 1}, SetpointLossEffect.SINK, FlightMode.ALTITUDE),
        ("1.16.2", False, {"COM_OBL_RC_ACT": 2}, SetpointLossEffect.DRIFT, FlightMode.STABILIZED),
        ("1.16.2", True, {}, SetpointLossEffect.PILOT, FlightMode.POSITION),
        ("1.16.2", False, {"COM_OBL_RC_ACT": 3}, SetpointLossEffect.RETURN, FlightMode.RETURN),
        ("1.16.2", False, {"COM_OBL_RC_ACT": 4}, SetpointLossEffect.LAND, FlightMode.LAND),
        ("1.16.2", False, {"COM_OBL_RC_ACT": 5}, SetpointLossEffect.HOLD, FlightMode.HOLD),
        ("1.16.2", False, {"COM_OBL_RC_ACT": 6}, SetpointLossEffect.FALL, FlightMode.UNKNOWN),
        ("1.16.2", False, {"COM_OBL_RC_ACT": 7}, SetpointLossEffect.FALL, FlightMode.UNKNOWN),
        ("1.18.0", False, {}, SetpointLossEffect.RETURN, FlightMode.RETURN),
    ],
)
def test_outcome_is_what_a_real_px4_did(
    version: str, sticks: bool, values: dict[str, float], effect: SetpointLossEffect, mode: FlightMode
) -> None:
    found = outcome(version, sticks=sticks, **values)
    assert (found.effect, found.mode) == (effect, mode)
    assert found.after_s == pytest.approx(1.1, abs=0.06)  # 1.06 to 1.16 s were measured
    assert found.text.count(version) == 1


# --- the function ------------------------------------------------------------------------------------


def test_danger_delay_and_the_unknown_are_warnings() -> None:
    assert outcome("1.16.2").warning  # it sinks
    assert outcome("1.16.2", COM_OBL_RC_ACT=2).warning  # it drifts
    assert outcome("1.17.0", NAV_RCL_ACT=6).warning  # it falls
    assert outcome("1.18.0", NAV_RCL_ACT=7).warning  # it flies on
    assert outcome("1.18.0", COM_OF_LOSS_T=2.5).warning
    assert not outcome("1.18.0", COM_OF_LOSS_T=1.5).warning
    assert not outcome("1.16.2", sticks=True).warning
    assert not outcome("1.16.2", COM_OBL_RC_ACT=5).warning


def test_nothing_read_is_unknown_and_a_warning() -> None:
    found = setpoint_loss_outcome(NOTHING_READ, sticks_present=False)
    assert (found.effect, found.after_s, found.warning) == (SetpointLossEffect.UNKNOWN, None, True)


@pytest.mark.parametrize("version", ["1.13.3", "1.19.0", "2.0.0"])
def test_version_that_nobody_examined_is_unknown(version: str) -> None:
    assert outcome(version).effect is SetpointLossEffect.UNKNOWN
    assert outcome(version, COM_OBL_RC_ACT=5).effect is SetpointLossEffect.UNKNOWN


def test_pre_releases_of_1_17_are_unknown_without_sticks() -> None:
    alpha = AutopilotParameters("PX4", FirmwareVersion.of(0x01110040), 1, tuple(PX4_DEFAULTS.items()))
    assert setpoint_loss_outcome(alpha, sticks_present=False).effect is SetpointLossEffect.UNKNOWN
    assert setpoint_loss_outcome(alpha, sticks_present=True).effect is SetpointLossEffect.PILOT


@pytest.mark.parametrize("missing", ["version", "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "NAV_RCL_ACT"])
def test_what_could_not_be_read_is_not_assumed(missing: str) -> None:
    values = tuple((name, value) for name, value in PX4_DEFAULTS.items() if name != missing)
    version = None if missing == "version" else FirmwareVersion(1, 18)
    found = setpoint_loss_outcome(AutopilotParameters("PX4", version, 1, values), sticks_present=False)
    assert found.effect is SetpointLossEffect.UNKNOWN
    assert missing in found.text


def test_version_text_and_order() -> None:
    assert str(FirmwareVersion.of(0x011002FF)) == "1.16.2"
    assert str(FirmwareVersion.of(0x01120080)) == "1.18.0-beta"
    assert FirmwareVersion.of(0x011000C0) < FirmwareVersion.of(0x011000FF)


def copter(minor: int = 5, **values: float) -> SetpointLossOutcome:
    version = FirmwareVersion(4, minor)
    read = {
        name: value
        for name, value in COPTER_DEFAULTS.items()
        if name in parameter_names("ArduPilot", version)
    }
    return setpoint_loss_outcome(
        AutopilotParameters("ArduPilot", version, 1, tuple({**read, **values}.items())), sticks_present=False
    )


def test_copter_flies_on_for_its_guided_timeout() -> None:
    long, short = copter(), copter(GUID_TIMEOUT=1)
    assert (long.effect, long.mode, long.after_s, long.warning) == (
        SetpointLossEffect.HOLD,
        FlightMode.OFFBOARD,
        3.0,
        True,
    )
    assert (short.after_s, short.warning) == (1.0, False)


@pytest.mark.parametrize(("minor", "name"), [(6, "SYSID_MYGCS"), (7, "MAV_GCS_SYSID")])
def test_copters_ground_station_failsafe_needs_our_id(minor: int, name: str) -> None:
    assert name in parameter_names("ArduPilot", FirmwareVersion(4, minor))
    assert "RTL 5 s later" in copter(minor, FS_GCS_ENABLE=1, **{name: 1}).text
    others = copter(minor, FS_GCS_ENABLE=1, **{name: 255}).text
    assert "RTL" not in others
    assert f"{name} 255" in others
    unread = copter(minor, FS_GCS_ENABLE=1, **{name: float("nan")}).text
    assert f"{name} could not" in unread


# --- the simulated vehicle does the same ------------------------------------------------------------------


def matrix() -> Iterator[object]:
    """Version × parameters × sticks; a few of them are not slow."""
    for release, act, sticks in itertools.product(RELEASES, range(8), (False, True)):
        if sticks and act > 2:
            continue
        fast = act in (0, 1, 5) and not sticks and release in ("1.16", "1.17", "1.18")
        yield pytest.param(release, act, 2, sticks, marks=() if fast else pytest.mark.slow)
    for release, act, lost in itertools.product(("1.16", "1.17", "1.18"), (0, 2), (0, 1, 3, 5, 6, 7)):
        fast = (act, lost) == (0, 7)
        yield pytest.param(release, act, lost, False, marks=() if fast else pytest.mark.slow)


@pytest.mark.parametrize(("release", "act", "lost_act", "sticks"), list(matrix()))
def test_simulated_vehicle_does_what_the_function_says(
    release: str, act: int, lost_act: int, sticks: bool
) -> None:
    parameters = {"COM_OBL_RC_ACT": act, "NAV_RCL_ACT": lost_act, "COM_OF_LOSS_T": 0.7}
    vehicle = LockstepVehicle({"onboard": RATES_HZ}, seed=3, noise=0.0, px4=release, parameters=parameters)
    vehicle.take_off(12.0, limit_s=90.0)
    vehicle.vehicle.autopilot.pilot_has_sticks = sticks
    driver = SimulatedDriver(vehicle)
    request = dialect.MAVLink_command_long_message(1, 1, dialect.MAV_CMD_DO_SET_MODE, 0, 1, 6, 0, 0, 0, 0, 0)
    for number in range(60):
        driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), driver.now_ns))
        if number == 10:
            vehicle.send(request)
        driver.step(0.05)
    assert driver.state.mode is FlightMode.OFFBOARD
    assert driver.state.sticks_present is sticks
    expected = setpoint_loss_outcome(driver.parameters, sticks_present=driver.state.sticks_present)
    stopped_ns, left_ns = driver.now_ns - 50_000_000, 0
    heights = []
    for _ in range(60):
        driver.step(0.1)
        heights.append(vehicle.truth.height_m)
        if not left_ns and vehicle.vehicle.autopilot.mode is not Mode.OFFBOARD:
            left_ns = driver.now_ns
    assert observed(vehicle, driver, heights, sticks=sticks) is expected.effect
    if expected.mode is not FlightMode.UNKNOWN:
        assert driver.state.mode is expected.mode
        assert expected.after_s is not None or expected.effect is SetpointLossEffect.FLY_ON
    if expected.after_s is not None and expected.mode is not FlightMode.UNKNOWN:
        assert (left_ns - stopped_ns) / 1e9 == pytest.approx(expected.after_s, abs=0.15)


def observed(
    vehicle: LockstepVehicle, driver: SimulatedDriver, heights: list[float], *, sticks: bool
) -> SetpointLossEffect:
    """What a vehicle does that was at 12 m, 6 s after its last setpoint."""
    if min(heights) < 1.0:
        return SetpointLossEffect.FALL
    match driver.state.mode:
        case FlightMode.OFFBOARD:
            assert vehicle.truth.velocity_ned_mps[0] == pytest.approx(1.0, abs=0.3)
            return SetpointLossEffect.FLY_ON
        case FlightMode.RETURN:
            return SetpointLossEffect.RETURN
        case FlightMode.LAND:
            return SetpointLossEffect.LAND
        case FlightMode.HOLD:
            assert heights[-1] == pytest.approx(12.0, abs=0.5)
            return SetpointLossEffect.HOLD
        case FlightMode.POSITION | FlightMode.ALTITUDE:
            sinks = heights[15] - heights[-1] > 2.0
            assert sinks or heights[-1] == pytest.approx(12.0, abs=0.5)
            return SetpointLossEffect.SINK if sinks else SetpointLossEffect.PILOT
        case FlightMode.STABILIZED:
            return SetpointLossEffect.PILOT if sticks else SetpointLossEffect.DRIFT
        case mode:
            raise AssertionError(mode)


# --- the documents -----------------------------------------------------------------------------------

_ROW = re.compile(
    r"^\| `?(?P<act>\d)`? [^|]*\| (?P<old>[^|]+) \| (?P<new>[^|]+) \| (?P<pilot>[^|]+) \|", re.MULTILINE
)


def test_table_of_the_docs_is_the_functions() -> None:
    rows = {int(row["act"]): row for row in _ROW.finditer(SAFETY.read_text())}
    assert sorted(rows) == list(range(8))
    for act, row in rows.items():
        for releases, key, sticks in (
            (("1.14.4", "1.15.4", "1.16.2"), "old", False),
            (("1.17.0", "1.18.0"), "new", False),
            (("1.14.4", "1.15.4", "1.16.2", "1.17.0", "1.18.0"), "pilot", True),
        ):
            for release in releases:
                assert (
                    row[key].split()[0].strip(",:")
                    == outcome(release, sticks=sticks, COM_OBL_RC_ACT=act).effect.value
                )


@pytest.mark.parametrize(
    ("state", "has_vehicle", "word"),
    [
        (VehicleState(), False, "no vehicle"),
        (VehicleState(), True, "no autopilot"),
        (VehicleState(autopilot="PX4", mode=FlightMode.OFFBOARD), True, "disarmed"),
        (VehicleState(autopilot="PX4", armed=True), True, "unknown mode"),
        (
            VehicleState(autopilot="PX4", armed=True, mode=FlightMode.PRECISION_LAND),
            True,
            "precision land mode",
        ),
        (VehicleState(autopilot="PX4", armed=True, mode=FlightMode.OFFBOARD), True, "sinks to the ground"),
        (
            VehicleState(autopilot="PX4", armed=True, mode=FlightMode.OFFBOARD, sticks_present=True),
            True,
            "flown by the sticks",
        ),
    ],
)
def test_what_a_vehicle_does_without_the_service(state: VehicleState, has_vehicle: bool, word: str) -> None:
    assert word in without_service_text(state, px4("1.16.2"), has_vehicle=has_vehicle)
