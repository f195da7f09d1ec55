"""After a suspend or a stop of the process nothing flies that was commanded before."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from companion.guidance.behaviour import VelocityInput
from companion.guidance.core import GuidanceOptions
from companion.guidance.formation.neighbours import Neighbour, Neighbourhood
from companion.guidance.gimbal.controller import GimbalMounting
from companion.guidance.interface import EventKind, GuidanceInput
from companion.vehicle.state import FlightMode, LandedState, with_fields
from companion.vehicle.vehicle_type import VtolState
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    ScriptedGimbal,
    assert_failed,
    engaged,
    hovering,
    mission,
    standing,
    with_state,
)

LEADER = Neighbour("alpha", (20.0, 0.0, -5.0), (0.0, 0.0, 0.0), 0.0, 0.0, age_s=0.1)


def with_leader(inputs: GuidanceInput) -> GuidanceInput:
    velocity = VelocityInput("pad", inputs.state.heartbeat_ns, inputs.state.heartbeat_ns + 10**9, 1.0)
    return replace(inputs, neighbourhood=Neighbourhood("own", (LEADER,)), velocities=(velocity,))


def on_ground() -> GuidanceHarness:
    return standing(lag_s=0.4)


def in_flight() -> GuidanceHarness:
    return hovering(lag_s=0.2, inputs=with_leader)


def _before_arming() -> GuidanceHarness:
    """The pre-arm checks still run."""
    harness = on_ground()
    harness._inputs = with_state(ready_to_arm=False)
    harness.command("takeoff 4")
    harness.run(0.5)
    assert harness.autopilot.requests == []
    return harness


def _while_arming() -> GuidanceHarness:
    harness = on_ground()
    harness.command("takeoff 4")
    assert harness.autopilot.requests == ["arm"]
    return harness


def _after_arming() -> GuidanceHarness:
    harness = _while_arming()
    harness.until(lambda: harness.autopilot.state.armed, 2.0)
    return harness


def _in_the_climb() -> GuidanceHarness:
    harness = on_ground()
    harness.command("takeoff 4")
    harness.until(lambda: harness.vehicle.position[2] < -1.0)
    return harness


def _end_of_the_climb() -> GuidanceHarness:
    """A short take-off is finished by setpoints, about to be requested."""
    harness = on_ground()
    harness.autopilot.takeoff_short_m = 0.7
    harness.command("takeoff 4")
    harness.until(lambda: harness.vehicle.landed is LandedState.IN_AIR)
    return harness


def _engaging() -> GuidanceHarness:
    harness = in_flight()
    harness.command("hold")
    harness.run()
    return harness


def _flown(text: str) -> Callable[[], GuidanceHarness]:
    def made() -> GuidanceHarness:
        harness = in_flight()
        harness.command(text)
        harness.until(lambda: harness.guidance.phase == "offboard")
        harness.run(0.5)
        return harness

    return made


def _hold_between_commands() -> GuidanceHarness:
    harness = in_flight()
    harness.outcome(harness.command("hold 0.2"))
    assert harness.guidance.phase == "offboard"
    return harness


def _mission(*steps: str, at: str) -> Callable[[], GuidanceHarness]:
    def made() -> GuidanceHarness:
        harness = on_ground()
        harness.command(mission(harness, *steps, each={"on_failure": "continue"}))
        runner = harness.guidance.runner
        harness.until(lambda: runner.active is not None and runner.active.name == at)
        harness.run(0.3)
        return harness

    return made


def _waiting_for_the_gimbal() -> GuidanceHarness:
    mounting = GimbalMounting(carries_camera=True, carries_steering=True)
    harness = hovering(lag_s=0.2, inputs=with_leader, options=GuidanceOptions(gimbal=mounting))
    harness.command("seek car sweep=-60")
    assert not harness.guidance.in_command
    return harness


PHASES: dict[str, Callable[[], GuidanceHarness]] = {
    "waiting for the gimbal": _waiting_for_the_gimbal,
    "before arming": _before_arming,
    "while arming": _while_arming,
    "after arming": _after_arming,
    "in the climb": _in_the_climb,
    "end of the climb": _end_of_the_climb,
    "engaging": _engaging,
    "hold": _hold_between_commands,
    "goto": _flown("goto 60 0"),
    "orbit": _flown("orbit radius=6"),
    "seek": _flown("seek car"),
    "follow-path": _flown("follow-path points=0,0;40,0"),
    "velocity": _flown("velocity"),
    "formation": _flown("formation line alpha"),
    "mission in goto": _mission("takeoff 3", "goto 30 0", "land", at="goto"),
    "mission in land": _mission("takeoff 3", "land", "takeoff 4", "hold 5", at="land"),
    "mission in takeoff": _mission("takeoff 3", "hold 5", "land", "takeoff 3", at="takeoff"),
}
STARTS = {"arm", "offboard", "takeoff 3", "takeoff 4", "mission", "takeoff"}


@pytest.mark.parametrize(
    ("seconds", "suspended"),
    [
        (0.2, True),
        (0.4, True),
        (1.0, True),
        (5.0, True),
        (60.0, True),
        (0.2, False),
        (4.0, False),
        (60.0, False),
    ],
)
@pytest.mark.parametrize("phase", PHASES)
def test_nothing_starts_after_a_standstill(phase: str, seconds: float, suspended: bool) -> None:
    harness = PHASES[phase]()
    harness.stand_still(seconds, suspended=suspended)
    requests = len(harness.autopilot.requests)
    active = harness.guidance.behaviour
    harness._inputs = with_leader
    harness.autopilot.gimbal = ScriptedGimbal()
    if seconds < 0.3:
        harness.run()
        assert active is None or harness.guidance.behaviour is active  # too short to matter
        return
    # What was sent to a suspended computer may arrive as late as the suspend was long.
    assert harness.silent(max(20.0, seconds + 1.0) if suspended else 20.0)
    assert not STARTS & set(harness.autopilot.requests[requests:])
    assert not harness.guidance.in_command
    # The operator's next command flies.
    if harness.vehicle.landed is LandedState.IN_AIR:
        engaged(harness)
        assert not harness.silent(0.1)


def test_end_of_the_command_names_the_suspend() -> None:
    harness = in_flight()
    pending = harness.command("goto north=50 east=0")
    harness.until(lambda: harness.guidance.phase == "offboard")
    harness.stand_still(42.0, suspended=True)
    harness.run()
    assert "suspended for 42.0 s" in pending.result().reason
    assert harness.events[-1].kind is EventKind.LOST


@pytest.mark.parametrize("suspended", [True, False])
def test_command_that_waited_in_a_buffer_is_refused(suspended: bool) -> None:
    harness = in_flight()
    harness.stand_still(30.0, suspended=suspended)
    first = harness.command("hold")  # read before guidance's first step
    assert not first.result().success
    # TCP sends again what a suspended computer has not received, as long after it as that lasted.
    late_s = 30.0 if suspended else 1.0
    harness.run(late_s - 0.5)
    assert not harness.command("hold").result().success
    harness.run(1.0)
    assert not harness.command("hold").done()


@pytest.mark.parametrize("command", ["stop", "land", "rtl"])
def test_commands_that_end_a_flight_are_not_refused(command: str) -> None:
    harness = in_flight()
    harness.stand_still(30.0, suspended=True)
    assert not harness.command(command).done()


class SilentUntilReceived:
    """The state as `TelemetryState.discard_received` leaves it, until `received`."""

    received = False

    def __call__(self, inputs: GuidanceInput) -> GuidanceInput:
        state = inputs.state if self.received else with_fields(inputs.state, heartbeat_ns=0, position_ns=0)
        return replace(with_leader(inputs), state=state)


@pytest.mark.parametrize("mode", [FlightMode.OFFBOARD, FlightMode.RETURN])
@pytest.mark.parametrize(("command", "request_"), [("stop", "hold"), ("land", "land"), ("rtl", "return")])
def test_commands_that_end_a_flight_wait_for_a_heartbeat(
    command: str, request_: str, mode: FlightMode
) -> None:
    harness = _flown("goto 60 0")()
    harness.stand_still(4.0, suspended=True)
    harness._inputs = silent = SilentUntilReceived()
    pending = harness.command(command)
    harness.run(0.9)
    assert not pending.done()
    # PX4 has left OFFBOARD meanwhile: the heartbeat shows a mode that was chosen before the command.
    harness.autopilot.change_mode(mode)
    harness.run(0.4)
    assert not pending.done()
    silent.received = True
    assert harness.outcome(pending).success
    assert harness.autopilot.requests[-1] == request_


def test_commands_that_end_a_flight_wait_for_the_vtol_state() -> None:
    harness = _flown("goto 60 0")()
    harness.stand_still(4.0, suspended=True)
    harness._inputs = with_state(mav_type=22, mav_autopilot=12, vtol_state=None)
    pending = harness.command("stop")
    harness.run(0.9)
    assert not pending.done()
    harness._inputs = with_state(mav_type=22, mav_autopilot=12, vtol_state=VtolState.MC)
    assert harness.outcome(pending).success


@pytest.mark.parametrize("newer", ["hold", "stop"])
def test_command_without_a_heartbeat_is_answered(newer: str) -> None:
    harness = _flown("goto 60 0")()
    harness.stand_still(1.0, suspended=True)
    harness._inputs = SilentUntilReceived()
    pending = harness.command("stop")
    harness.run(1.1)  # until then only commands that end a flight are accepted
    second = harness.command(newer)
    assert "superseded" in pending.result().reason
    harness.run(5.0)
    assert "no link" in second.result().reason


def test_pilot_flies_on_after_a_standstill() -> None:
    harness = _flown("goto 60 0")()
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.stand_still(10.0, suspended=True)
    harness.run(5.0)
    assert harness.vehicle.mode is FlightMode.POSITION


def test_track_from_before_a_suspend_is_forgotten() -> None:
    harness = in_flight()
    harness.stand_still(30.0, suspended=True)
    harness.run(1.1)
    assert_failed(harness.command("approach track=7").result())


def test_waiting_command_is_answered_after_a_standstill() -> None:
    harness = in_flight()
    pending = harness.command("seek car sweep=-60")
    harness.stand_still(1.0, suspended=True)
    harness.step()
    assert_failed(pending.result())
