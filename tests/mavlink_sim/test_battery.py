"""The battery: discharge, telemetry, warnings and their failsafes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.physics.airframe import GRAVITY_MPS2, MAX_THRUST_MPS2
from mavlink_sim.physics.battery import Battery, BatteryWarning
from mavlink_sim.px4.parameters import Parameters
from tests.mavlink_sim.conftest import SimHarness

GROUND_STATION = (245, 190)
EMERGENCY = "Emergency battery level\t"  # STATUSTEXT of PX4
CHECKED = {"CBRK_SUPPLY_CHK": 0, "SIM_BAT_MIN_PCT": 0}


def drained(seconds: float, thrust_mps2: float = GRAVITY_MPS2, **values: float) -> Battery:
    battery = Battery(Parameters(values))
    for _ in range(round(seconds / 0.1)):
        battery.step(0.1, True, thrust_mps2)
    return battery


def test_the_simulated_battery_drains_and_sinks_as_recorded() -> None:
    battery = drained(10.0)
    assert battery.volts == pytest.approx(15.9, abs=0.01)  # 10 s after arming
    assert battery.remaining == pytest.approx(0.85, abs=0.01)
    assert battery.current_a == -1.0
    assert battery.discharged_mah == pytest.approx(-2.8, abs=0.1)
    battery = drained(60.0)
    assert battery.charge == 0.5  # SIM_BAT_MIN_PCT
    assert battery.volts == pytest.approx(15.3)
    for _ in range(40):
        battery.step(0.1, False, 0.0)
    assert battery.remaining == pytest.approx(1.0, abs=0.02)  # disarmed, it is full again


def test_a_battery_of_known_capacity_has_a_current_and_sags() -> None:
    values = {"BAT1_CAPACITY": 1000.0, "BAT_AVRG_CURRENT": 15.0, "BAT1_R_INTERNAL": 0.01}
    battery = drained(60.0, **values)
    assert battery.current_a == pytest.approx(15.5)
    assert battery.discharged_mah == pytest.approx(15.5 * 1000 / 60, rel=0.01)
    assert battery.charge == pytest.approx(1 - 0.258, abs=0.01)
    harder = drained(60.0, MAX_THRUST_MPS2, **values)
    assert harder.current_a > 2.5 * battery.current_a
    rest = Battery(Parameters(values))
    rest.step(0.1, False, 0.0)
    loaded = Battery(Parameters(values))
    loaded.step(0.1, True, MAX_THRUST_MPS2)
    assert loaded.volts < rest.volts - 1.0
    assert battery.time_remaining_s == pytest.approx(0.742 * 3600 / 15.5, rel=0.1)
    battery.step(10.0, False, 0.0)
    assert battery.charge < 0.75  # the used charge is not restored


@given(
    st.floats(0.0, 30.0),
    st.floats(-10.0, 1e6),
    st.lists(st.tuples(st.booleans(), st.floats(0.0, 20.0)), max_size=20),
)
def test_a_battery_stays_within_its_bounds(
    drain_s: float, capacity_mah: float, steps: list[tuple[bool, float]]
) -> None:
    battery = Battery(Parameters({"SIM_BAT_DRAIN": drain_s, "BAT1_CAPACITY": capacity_mah}))
    for armed, thrust in steps:
        battery.step(1.0, armed, thrust)
        assert 0.0 <= battery.remaining <= 1.0
        assert 0.0 <= battery.charge <= 1.0
        assert math.isfinite(battery.volts)


def test_the_warnings_follow_the_thresholds() -> None:
    parameters = Parameters({"SIM_BAT_MIN_PCT": 0, "SIM_BAT_DRAIN": 100, "CBRK_SUPPLY_CHK": 0})
    battery = Battery(parameters)
    seen: dict[BatteryWarning, float] = {}
    for number in range(1100):
        battery.step(0.1, True, 9.8)
        seen.setdefault(battery.warning, battery.remaining)
        assert battery.charge_state == 1 + battery.warning
        assert battery.checked_warning is battery.warning, number
    assert seen[BatteryWarning.LOW] == pytest.approx(0.15, abs=0.002)
    assert seen[BatteryWarning.CRITICAL] == pytest.approx(0.07, abs=0.002)
    assert seen[BatteryWarning.EMERGENCY] == pytest.approx(0.05, abs=0.002)


def test_unchecked_battery_has_no_warning() -> None:
    battery = Battery(Parameters({"SIM_BAT_MIN_PCT": 0, "SIM_BAT_DRAIN": 1}))  # CBRK_SUPPLY_CHK is 894281
    for _ in range(50):
        battery.step(0.1, True, 9.8)
    assert battery.warning is BatteryWarning.EMERGENCY
    assert battery.checked_warning is BatteryWarning.NONE


def flying(**values: float) -> SimHarness:
    harness = SimHarness(parameters={**CHECKED, "COM_FAIL_ACT_T": 1, **values})
    harness.heartbeats.append(("gcs", GROUND_STATION, 6))
    harness.take_off(11.0)
    return harness


def test_low_battery_warns_returns_and_lands() -> None:
    harness = flying(RTL_RETURN_ALT=12, SIM_BAT_DRAIN=3000)
    harness.vehicle.autopilot.supervision.battery.charge = 0.12
    harness.until(lambda: any(line.startswith("battery low") for line in harness.events), 8.0)
    harness.fly(0.1)
    assert "Low battery\t" in harness.texts()
    assert harness.mode == "HOLD"
    harness.vehicle.autopilot.supervision.battery.charge = 0.06
    harness.until(lambda: "failsafe: battery critical, HOLD" in harness.events, 10.0)
    harness.until(lambda: "failsafe: battery critical, RTL" in harness.events, 2.0)
    harness.vehicle.autopilot.supervision.battery.charge = 0.04
    harness.until(lambda: harness.mode == "LAND", 8.0)
    assert harness.heartbeat().system_status == 5
    harness.fly(2.1)
    assert harness.received("BATTERY_STATUS")[-1].charge_state == 4


def test_by_default_a_battery_does_not_end_a_flight() -> None:
    harness = SimHarness(parameters={"SIM_BAT_MIN_PCT": 0, "SIM_BAT_DRAIN": 10})
    harness.take_off()
    harness.fly(4.0)
    assert harness.mode == "HOLD"
    assert harness.received("BATTERY_STATUS")[-1].charge_state == 4


def test_arming_is_refused_on_an_empty_battery() -> None:
    harness = SimHarness(parameters=CHECKED)
    harness.heartbeats.append(("gcs", GROUND_STATION, 6))
    harness.wait_ready()
    harness.vehicle.autopilot.supervision.battery.forced_charge = 0.0
    harness.fly(6.0)
    assert not harness.vehicle.autopilot.can_arm
    assert harness.command(400, 1) == [1]
    assert EMERGENCY in harness.texts()
    harness.vehicle.autopilot.supervision.battery.forced_charge = None
    harness.fly(6.0)
    assert harness.command(400, 1) == [0]


def test_com_arm_bat_min_sets_the_charge_that_arming_needs() -> None:
    harness = SimHarness(parameters={**CHECKED, "COM_ARM_BAT_MIN": 0.9, "BAT1_V_CHARGED": 4.2})
    harness.wait_ready()
    battery = harness.vehicle.autopilot.supervision.battery
    battery.forced_charge = 0.0
    harness.until(lambda: battery.remaining < 0.9, 2.0)
    assert battery.warning is BatteryWarning.NONE
    assert harness.command(400, 1) == [1]
    battery.forced_charge = None
    harness.until(lambda: battery.remaining > 0.91, 5.0)
    assert harness.command(400, 1) == [0]


def test_missing_battery_is_reported() -> None:
    harness = SimHarness(parameters={"SIM_BAT_ENABLE": 0})
    harness.fly(2.2)
    assert harness.received("BATTERY_STATUS") == []
    status = harness.received("SYS_STATUS")[-1]
    assert (status.voltage_battery, status.current_battery, status.battery_remaining) == (65535, -1, -1)
