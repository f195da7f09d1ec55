"""The dead-man, the pilot and the limits, on the autopilot at COMPANION_SITL_URL."""

from __future__ import annotations

import math
import signal
import time
from itertools import pairwise

import pytest

from mavlink_sim.wire.messages import dialect
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import (
    ARDUPILOT,
    HOLD,
    NAMED_BY,
    NAMES,
    OFFBOARD,
    PX4,
    READY_S,
    STANDING_MPS,
    AutopilotLink,
    Flight,
    Pose,
    command_or_skip,
    needs_px4,
    orbiting,
    set_for_test,
)

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(400), pytest.mark.realtime]
# A setpoint that was being sent when the mode changed; and one heartbeat period for a mode to show.
IN_TRANSIT_S, WATCHED_S = 0.3, 3.0


def standing(link: AutopilotLink, since_s: float) -> tuple[float, float]:
    """Wait until it stands; seconds and metres from a moment on."""

    def stood() -> Pose | None:
        return next((pose for pose in link.trajectory(since_s) if pose.speed_mps < STANDING_MPS), None)

    link.until(stood, 20.0, "standing")
    end = stood()
    assert end is not None
    places = [pose.position_ned_m[:2] for pose in link.trajectory(since_s, end.time_s)]
    return end.time_s - since_s, sum(math.dist(one, other) for one, other in pairwise(places))


def silent(link: AutopilotLink, since_s: float, seconds: float = WATCHED_S) -> int:
    """How many setpoints came from a moment on until so many seconds from now."""
    link.after(seconds)
    return sum(at > since_s for at in link.setpoints_s)


def test_a_pilots_change_of_mode_ends_the_command(flight: Flight) -> None:
    link = flight.link
    orbiting(flight)
    lost = flight.said("the pilot took over: hold mode")
    asked_s = time.monotonic()
    link.set_mode(HOLD[link.autopilot or 0])
    shown_s = link.until(lambda: not link.offboard, 3.0, "in the pilot's mode")
    link.until(lost, 3.0, "reported as the pilot's")
    assert silent(link, asked_s + shown_s + IN_TRANSIT_S) == 0
    last_s = link.setpoints_s[-1] - asked_s - shown_s
    flight.note("pilot's change of mode", shown_after_s=shown_s, last_setpoint_after_s=last_s)
    # OFFBOARD again, and not by us: nothing is sent. (PX4 refuses it without a stream.)
    again_s = time.monotonic()
    link.set_mode(OFFBOARD[link.autopilot or 0])
    assert silent(link, again_s) == 0
    flight.fly("land")


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL], ids=lambda number: number.name)
def test_a_service_that_hangs_or_dies_ends_the_flight(flight: Flight, number: signal.Signals) -> None:
    link = flight.link
    orbiting(flight)
    speed_mps = link.poses[-1].speed_mps
    fault_s = time.monotonic()
    flight.service.signal(number)
    try:
        stands_s, flown_m = standing(link, fault_s)
        link.after(0.5)
        left_s = link.left_offboard_s(fault_s)
    finally:
        if number is signal.SIGSTOP:
            resumed_s = time.monotonic()
            flight.service.signal(signal.SIGCONT)
    guided_s = link.parameter("GUID_TIMEOUT") if link.autopilot == ARDUPILOT else None
    flight.note(
        f"kill -{'STOP' if number is signal.SIGSTOP else '9'} at speed",
        speed_mps=speed_mps,
        left_offboard_s=left_s,
        stands_s=stands_s,
        flown_m=flown_m,
        GUID_TIMEOUT=guided_s,
    )
    if link.autopilot == PX4:
        loss_s = link.parameter("COM_OF_LOSS_T")
        assert loss_s is not None
        assert left_s is not None
        # PX4 before 1.15 has no CURRENT_MODE: the mode is shown by the next HEARTBEAT.
        assert left_s < loss_s + (0.5 if link.version >= (1, 15) else 1.5)
    else:
        assert guided_s is not None
        assert left_s is None
        assert stands_s < guided_s + 3.0
    if number is signal.SIGKILL:
        flight.service.process.wait(10)
    else:
        # It goes on where it was: what was about to be sent has expired, and nothing follows.
        assert silent(link, resumed_s) == 0
        flight.fly("land")


def test_a_service_that_is_ended_lets_the_autopilot_hold(flight: Flight) -> None:
    link = flight.link
    orbiting(flight)
    speed_mps = link.poses[-1].speed_mps
    asked_s = time.monotonic()
    flight.service.signal(signal.SIGTERM)
    link.until(lambda: link.modes[-1][1] == HOLD[link.autopilot or 0], 3.0, "in hold")
    stands_s, flown_m = standing(link, asked_s)
    assert flight.service.process.wait(20) == 0
    flight.note("SIGTERM at speed", speed_mps=speed_mps, stands_s=stands_s, flown_m=flown_m)


def test_a_lost_link_ends_the_command_and_is_not_resumed(flight: Flight) -> None:
    link = flight.link
    orbiting(flight)
    speed_mps = link.poses[-1].speed_mps
    lost, back = flight.said("command lost"), flight.said("autopilot heartbeat received")
    cut_s = time.monotonic()
    link.cut = True
    reported_s = link.until(lost, 10.0, "reported as lost")
    stands_s, flown_m = standing(link, cut_s)
    left_s = link.left_offboard_s(cut_s)
    link.after(4.0)
    link.cut = False
    found_s = link.until(back, 10.0, "found again")
    assert silent(link, time.monotonic()) == 0
    flight.fly("land")
    flight.note(
        "link loss at speed",
        speed_mps=speed_mps,
        left_offboard_s=left_s,
        stands_s=stands_s,
        flown_m=flown_m,
        reported_s=reported_s,
        found_after_s=found_s,
    )


def assert_arming_is_refused(flight: Flight, *reasons: str) -> None:
    """For one of these reasons: an autopilot's words change with its version."""
    link = flight.link
    link.until(lambda: not link.ready, 10.0, "not ready to be armed")
    reply = flight.command("takeoff 3")
    assert not reply["success"]
    assert any(reason.lower() in reply["reason"].lower() for reason in reasons), reply
    assert not link.armed


@pytest.mark.parametrize(
    ("autopilot", "name", "value", "reason"),
    [
        (PX4, "NAV_DLL_ACT", 2.0, "No connection to the G"),  # "GCS" or "ground control station"
        (ARDUPILOT, "BATT_ARM_VOLT", 90.0, "below minimum arming voltage"),
    ],
)
def test_refused_arming_has_the_autopilots_own_reason(
    flight: Flight, parameters: dict[str, float], autopilot: int, name: str, value: float, reason: str
) -> None:
    if flight.link.autopilot != autopilot:
        pytest.skip(f"{name} is a parameter of {NAMES[autopilot]}")
    parameters |= set_for_test(flight.link, {name: value})
    assert_arming_is_refused(flight, reason)


@pytest.mark.parametrize(
    ("cause", "cure", "reasons"),
    [
        (
            "sensor_mag_sim stop",
            "sensor_mag_sim start",
            ("Found 0 compass (required: 1)", "Compass sensor 0 missing"),
        ),
        ("param set COM_ARMABLE 0", "param set COM_ARMABLE 1", ("Vehicle is in safety configuration",)),
    ],
)
def test_a_failing_check_of_px4_is_the_reason(
    flight: Flight, cause: str, cure: str, reasons: tuple[str, ...]
) -> None:
    link = flight.link
    if link.autopilot != PX4:
        pytest.skip("the shell is PX4's")
    if "COM_ARMABLE" in cause and link.parameter("COM_ARMABLE") is None:
        pytest.skip(f"{link.name} has no COM_ARMABLE")
    link.shell(cause)
    try:
        assert_arming_is_refused(flight, *reasons)
    finally:
        link.shell(cure)
        link.until(lambda: link.ready, READY_S, "ready to be armed")


def test_a_safety_switch_is_the_reason(flight: Flight) -> None:
    link = flight.link
    if link.autopilot != ARDUPILOT:
        pytest.skip("PX4's simulation has no safety switch")
    switch = dialect.MAV_CMD_DO_SET_SAFETY_SWITCH_STATE
    command_or_skip(link, switch, dialect.SAFETY_SWITCH_STATE_SAFE)
    try:
        assert_arming_is_refused(flight, "Hardware safety switch")
    finally:
        link.command(switch, dialect.SAFETY_SWITCH_STATE_DANGEROUS)
        link.until(lambda: link.ready, READY_S, "ready to be armed")


@pytest.mark.parametrize(("timeout_s", "warned"), [(3.0, True), (1.0, False)])
def test_a_long_guid_timeout_is_warned_of(
    flight: Flight, services: Services, parameters: dict[str, float], timeout_s: float, warned: bool
) -> None:
    link = flight.link
    if link.autopilot != ARDUPILOT:
        pytest.skip("PX4 has no GUID_TIMEOUT")
    parameters |= set_for_test(link, {"GUID_TIMEOUT": timeout_s})
    services.close()
    link.parameters.pop("GUID_TIMEOUT")
    service = services.flight(flight.driver).service
    link.until(lambda: "GUID_TIMEOUT" in link.parameters, 10.0, "asked for GUID_TIMEOUT")
    if warned:
        service.wait_for_line("GUID_TIMEOUT is 3 s", 10.0)
    else:
        link.after(WATCHED_S)
        service.last_lines()
        assert not [line for line in service.lines if "set GUID_TIMEOUT" in line]


def test_points_beyond_the_limits_are_refused(flight: Flight) -> None:
    link = flight.link
    flight.take_off(4.0)
    start = link.poses[-1].position_ned_m
    for text, limit in (("goto 0 0 altitude=90", "max_altitude_m"), ("goto 500 0", "max_distance_m")):
        reply = flight.command(text)
        assert not reply["success"]
        assert limit in reply["reason"]
    link.after(2.0)
    assert math.dist(link.poses[-1].position_ned_m, start) < 1.5
    flight.fly("land")


def test_the_autopilots_geofence_is_named(flight: Flight, parameters: dict[str, float]) -> None:
    link = flight.link
    needs_px4(link, (1, 15), NAMED_BY)
    if link.autopilot == PX4:
        values = {"GF_MAX_HOR_DIST": 15.0, "GF_ACTION": 2.0}
    else:
        values = {"FENCE_TYPE": 2.0, "FENCE_RADIUS": 15.0, "FENCE_ACTION": 4.0, "FENCE_ENABLE": 1.0}
        if link.parameter("AVOID_ENABLE") is not None:
            values |= {"AVOID_ENABLE": 0.0}  # else it stops inside the fence, and no mode changes
    flight.take_off(5.0)  # home is here now, wherever the flight before ended
    parameters |= set_for_test(link, values)
    home = link.poses[-1].position_ned_m
    reply = flight.command("goto 40 0")
    assert not reply["success"]
    assert "fence" in reply["reason"].lower(), (reply, link.modes[-6:], link.commands[-12:])
    link.after(WATCHED_S)
    if link.autopilot == PX4:
        assert reply["reason"].startswith("autopilot failsafe: ")
        assert "hold mode" in reply["reason"]
        assert link.modes[-1][1] == HOLD[PX4], reply  # it holds, and does not return
    flight.note("geofence of 15 m", at_m=math.dist(link.poses[-1].position_ned_m[:2], home[:2]))
