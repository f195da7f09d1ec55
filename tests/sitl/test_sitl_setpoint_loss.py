"""What silence does on the autopilot at COMPANION_SITL_URL, against what the service says it will do."""

from __future__ import annotations

import signal
import time

import pytest

from companion.vehicle.ardupilot_profile import mode_of_custom_mode as copter_mode
from companion.vehicle.px4_modes import mode_of_custom_mode
from companion.vehicle.setpoint_loss import SetpointLossEffect
from tests.sitl.sitl_harness import PX4, Flight, set_for_test

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
HEIGHT_M = 8.0
WATCHED_S = 12.0
# COM_OBL_RC_ACT of PX4, without sticks. Not flown: 2 keeps the last tilt and thrust, 6 and 7 stop the motors.
ACTIONS = (0, 1, 3, 4, 5)
# The height changes by less in a hold, and falls by more where it sinks or lands.
HELD_M, SUNK_M = 2.0, 2.5


@pytest.mark.parametrize("action", ACTIONS)
def test_silence_does_what_the_service_says(
    flight: Flight, parameters: dict[str, float], action: int
) -> None:
    """The service is stopped in OFFBOARD; it has read the parameters when its link opened."""
    link = flight.link
    if link.autopilot == PX4:
        parameters |= set_for_test(link, {"COM_OBL_RC_ACT": float(action)})
    elif action:
        pytest.skip("ArduPilot has no such parameter")
    # A lost link that returns has the parameters read again.
    before = flight.status["vehicle"]["silence"]["text"] if flight.status else ""
    link.cut = True
    link.after(4.0)
    link.cut = False
    link.until(
        lambda: (
            flight.status["vehicle"]["connected"] and flight.status["vehicle"]["silence"]["mode"] != "unknown"
        ),
        30.0,
        f"connected again; {before}",
    )
    link.after(3.0)
    flight.take_off(HEIGHT_M)
    flight.fly("hold")
    link.after(3.0)
    said = flight.status["vehicle"]["silence"]
    height_m, stopped_s = link.height_m, time.monotonic()
    flight.service.signal(signal.SIGSTOP)
    try:
        left_s = None
        if link.autopilot == PX4:
            link.until(lambda: not link.offboard, 5.0, "out of OFFBOARD")
            left_s = link.left_offboard_s(stopped_s)
        link.after(WATCHED_S)
        shown = link.modes[-1][1]
        fell_m = height_m - link.height_m
    finally:
        flight.service.signal(signal.SIGCONT)
    flight.note(f"silence, COM_OBL_RC_ACT {action}, {said['effect']}", left_offboard_s=left_s, fell_m=fell_m)
    if link.autopilot != PX4:
        assert said["effect"] == SetpointLossEffect.HOLD
        assert copter_mode(shown).value == said["mode"]
        assert abs(fell_m) < HELD_M
        return
    assert mode_of_custom_mode(shown).value == said["mode"], said
    assert left_s is not None
    late_s = 0.0 if link.version >= (1, 15) else 1.0  # without CURRENT_MODE, HEARTBEAT shows it once a second
    assert -0.4 < left_s - said["after_s"] < 0.4 + late_s
    effect = SetpointLossEffect(said["effect"])
    assert said["warning"] is (effect is SetpointLossEffect.SINK)
    if effect in (SetpointLossEffect.SINK, SetpointLossEffect.LAND):
        assert fell_m > SUNK_M
    elif effect is SetpointLossEffect.HOLD:
        assert abs(fell_m) < HELD_M


@pytest.mark.parametrize("height_m", [1.2, 1.5, 2.0])
@pytest.mark.parametrize("again", range(7))
def test_low_take_off_reaches_its_height(flight: Flight, height_m: float, again: int) -> None:
    flight.take_off(height_m)
    flight.note(f"takeoff {height_m:g}, flight {again}", height_m=flight.link.height_m)
    assert flight.link.height_m == pytest.approx(height_m, abs=0.5)
    flight.fly("land")
