"""Reasons of a loss of command: autopilot failsafe or pilot."""

from dataclasses import replace

import pytest

from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.guidance.interface import GuidanceInput
from companion.guidance.mode_control import REASON_WAIT_S
from companion.vehicle.report import Report
from companion.vehicle.state import FlightMode
from mavlink_sim.px4.modes import Mode
from mavlink_sim.wire.messages import dialect
from tests.companion.guidance.guidance_harness import (
    STEP_S,
    GuidanceHarness,
    assert_failed,
    engaged,
    flying,
    in_the_air,
)

SOON = {"COM_FAIL_ACT_T": 0.0}
FENCE = {"GF_MAX_HOR_DIST": 10.0}
LASTING = "commander_failsafe_enter_generic"
BREACH = "Geofence violation: exceeding maximum distance to Home"


@pytest.mark.parametrize(
    ("parameters", "fault", "mode", "cause", "later"),
    [
        ({"GF_ACTION": 2.0, **FENCE}, None, "hold", BREACH, Mode.HOLD),
        ({"GF_ACTION": 3.0, **FENCE}, None, "hold", BREACH, Mode.RTL),  # after COM_FAIL_ACT_T
        ({"GF_ACTION": 3.0, **FENCE, **SOON}, None, "return", BREACH, Mode.RTL),
        ({}, "battery critical", "hold", "Critical battery level", Mode.RTL),
        (SOON, "battery critical", "return", "Critical battery level", Mode.RTL),
        (SOON, "battery emergency", "land", "Emergency battery level", Mode.LAND),
        ({"COM_RC_IN_MODE": 1.0, "COM_RCL_EXCEPT": 0.0}, "sticks", "hold", "Manual control loss", Mode.RTL),
    ],
)
def test_px4_failsafe_has_its_cause_and_is_left_to_px4(
    parameters: dict[str, float], fault: str | None, mode: str, cause: str, later: Mode
) -> None:
    """Also its hold, which PX4 would leave for a return 1.2 s after our last setpoint."""
    settings = plain_settings({"guidance.min_battery_percent": "0"})
    flight = LockstepFlight.of_vehicle(in_the_air(seed=4), settings=settings)
    for name, value in parameters.items():
        flight.vehicle.vehicle.parameters.set(name, value)
    identifier = flight.command("goto 45 0")
    if fault == "sticks":
        for _ in range(20):
            flight.vehicle.send(dialect.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0))
            flight.run(0.1)
        assert flight.outcome(identifier) is None
    else:
        flight.run(2.0)
        if fault is not None:
            flight.vehicle.vehicle.faults.begin(fault)
    assert flight.run_until(lambda: flight.outcome(identifier), 30.0)
    assert_failed(flight.outcome(identifier), "autopilot failsafe", f"{mode} mode", cause)
    flight.run(7.0)
    assert flight.vehicle.vehicle.autopilot.mode is later


@pytest.mark.parametrize(
    ("intended", "who"),
    [
        (FlightMode.OFFBOARD, "autopilot failsafe"),
        (FlightMode.RETURN, "pilot took over"),
    ],
)
@pytest.mark.parametrize("late_s", [0.0, 0.1, 2.0])
def test_heartbeat_first_stops_stream_and_waits_for_reason(
    intended: FlightMode, who: str, late_s: float
) -> None:
    changed_ns: list[int] = []

    def modify(inputs: GuidanceInput) -> GuidanceInput:
        """CURRENT_MODE, `late_s` after HEARTBEAT."""
        state = inputs.state
        reported = state.mode is FlightMode.RETURN and state.heartbeat_ns - changed_ns[0] >= late_s * 1e9
        return replace(
            inputs,
            state=replace(
                state,
                intended_mode=intended if reported else FlightMode.OFFBOARD,
                intended_beside=state.mode if reported else FlightMode.OFFBOARD,
            ),
        )

    harness = GuidanceHarness(flying(), inputs=modify)
    future = engaged(harness, "orbit")
    harness.autopilot.change_mode(FlightMode.RETURN)
    changed_ns.append(harness.vehicle.now_ns)
    harness.run()
    assert harness.silent(max(late_s, STEP_S))
    if late_s > REASON_WAIT_S:  # never reported: not requested by us
        who = "pilot took over"
    assert_failed(future.result(), who, "return mode")
    harness.autopilot.change_mode(FlightMode.OFFBOARD)
    assert harness.silent(2.0)


def failsafe_in_hold(name: str, text: str, late_s: float) -> GuidanceHarness:
    """OFFBOARD ends in a failsafe that shows HOLD. PX4 reports the cause first; its event may come later."""
    changed_ns: list[int] = []

    def modify(inputs: GuidanceInput) -> GuidanceInput:
        state = inputs.state
        reports: tuple[Report, ...] = (Report(state.heartbeat_ns - 5_000_000_000, 4, "Low battery"),)
        if state.mode is FlightMode.HOLD and changed_ns:
            reports += (
                Report(state.heartbeat_ns, 3, "No manual control input", "arming_check", modes=0b111),
            )
            if state.heartbeat_ns - changed_ns[0] >= late_s * 1e9:
                reports += (Report(changed_ns[0], 2, text, "default", name),)
        changed = replace(
            state, intended_mode=FlightMode.OFFBOARD, intended_beside=state.mode, reports=reports
        )
        return replace(inputs, state=changed)

    harness = GuidanceHarness(flying(), inputs=modify)
    pending = engaged(harness, "orbit radius=5")
    harness.autopilot.requests.clear()
    harness.autopilot.change_mode(FlightMode.HOLD)
    changed_ns.append(harness.vehicle.now_ns)
    harness.run(late_s + 0.1)
    words = [text] if late_s == 0.0 else []
    assert_failed(pending.result(), "autopilot failsafe", "hold mode", *words)
    harness.run(3.0)
    assert not harness.guidance.in_command
    return harness


@pytest.mark.parametrize(
    ("name", "text", "late_s", "asks"),
    [
        (LASTING, "Failsafe activated: switching to Hold", 0.0, ["hold"]),
        (LASTING, "Failsafe activated: switching to Hold", 0.1, ["hold"]),
        (LASTING, "Failsafe activated: switching to Hold", 0.25, ["hold"]),
        (f"{LASTING}_hold", "Failsafe activated: switching to RTL in 5 seconds", 0.0, []),
    ],
)
def test_lasting_hold_is_confirmed_one_before_rtl_is_not(
    name: str, text: str, late_s: float, asks: list[str]
) -> None:
    """PX4 leaves its hold for a return when setpoints stop, unless hold was requested last."""
    assert failsafe_in_hold(name, text, late_s).autopilot.requests == asks
