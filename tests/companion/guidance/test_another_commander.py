"""Another commander steers the vehicle without a mode change, in lockstep: our command ends."""

from __future__ import annotations

import math

import pytest

from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.bench.simulated_driver import RATES_HZ, SimulatedDriver
from companion.guidance.interface import EventKind
from companion.guidance.limits.setpoint_monitor import REASON
from companion.guidance.mode_control import Phase
from companion.vehicle.state import FlightMode
from companion.vehicle.streamer import StreamState
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.wire.messages import dialect
from mavlink_sim.wire.setpoints import velocity_setpoint
from tests.companion.guidance.guidance_harness import assert_failed, in_the_air, known

STATION = (255, 190)
PAUSE, CONTINUE = 0.0, 1.0


def airborne(autopilot: str) -> LockstepFlight:
    """In wind and gusts, 6 m above home."""
    return LockstepFlight.of_vehicle(
        in_the_air(seed=1, height_m=6.0, wind_mps=2.0, gusts_mps=0.4, autopilot=autopilot)
    )


def pause_or_continue(flight: LockstepFlight, choice: float) -> None:
    """DO_PAUSE_CONTINUE of a ground station."""
    number = dialect.MAV_CMD_DO_PAUSE_CONTINUE
    message = dialect.MAVLink_command_long_message(1, 1, number, 0, choice, *[0.0] * 6)
    flight.vehicle.send(message, source=STATION)


def speed_mps(flight: LockstepFlight) -> float:
    return math.hypot(*flight.vehicle.truth.velocity_ned_mps)


def lost(flight: LockstepFlight) -> bool:
    """Command was lost because the vehicle does not follow, and the stream has stopped."""
    losses = [event for event in flight.events if event.kind is EventKind.LOST]
    if not losses:
        return False
    assert REASON in losses[-1].message
    assert flight.guidance.phase is Phase.IDLE
    flight.run(0.1)
    assert flight.streamer.state is StreamState.SILENT
    return True


@pytest.mark.parametrize(
    "command",
    [
        "orbit radius=8 speed=2",
        *(pytest.param(text, marks=pytest.mark.slow) for text in ("goto forward=60 right=0", "figure-eight")),
    ],
)
def test_pause_by_ground_station_ends_command(command: str) -> None:
    flight = airborne("ardupilot")
    flight.command(command)
    flight.run(8.0)
    assert flight.guidance.busy
    pause_or_continue(flight, PAUSE)
    paused_ns = flight.now_ns
    assert flight.run_until(lambda: lost(flight), 6.0)
    assert (flight.now_ns - paused_ns) / 1e9 < 4.0
    assert flight.state.mode is FlightMode.OFFBOARD


def test_no_motion_after_pause_and_continue() -> None:
    """Regression: it flew on at 3 m/s."""
    flight = airborne("ardupilot")
    flight.command("orbit radius=8 speed=3")
    flight.run(8.0)
    pause_or_continue(flight, PAUSE)
    assert flight.run_until(lambda: lost(flight), 6.0)
    flight.run(4.0)  # GUID_TIMEOUT
    pause_or_continue(flight, CONTINUE)
    flight.run(1.0)
    for _ in range(30):
        flight.run(0.1)
        assert speed_mps(flight) < 1.0


def test_orbit_ends_when_autopilot_fence_stops_it() -> None:
    flight = airborne("ardupilot")
    for name, value in (("FENCE_ENABLE", 1), ("FENCE_RADIUS", 30)):
        flight.vehicle.vehicle.parameters.set(name, value)
    flight.fly("goto forward=20 right=0", 30.0)
    identifier = flight.command("orbit radius=15 speed=2 laps=1")
    assert flight.run_until(lambda: lost(flight), 90.0)
    assert_failed(flight.outcome(identifier))
    north, east, _ = flight.vehicle.truth.position_ned_m
    assert 26.0 < math.hypot(north, east) < 29.0  # FENCE_MARGIN is 2


@pytest.mark.other_commander
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_setpoints_of_another_commander_end_hold(autopilot: str) -> None:
    flight = airborne(autopilot)
    flight.command("hold")
    flight.run(6.0)
    assert flight.guidance.phase is Phase.OFFBOARD
    flight.vehicle.repeat(velocity_setpoint(3.0, 0.0, 0.0), 150.0, source=STATION)
    assert flight.run_until(lambda: lost(flight), 6.0)


@pytest.mark.other_commander
@pytest.mark.parametrize(("rate_hz", "within_s"), [(2.0, 60.0), (10.0, 10.0), (50.0, 3.0)])
@pytest.mark.parametrize("command", ["hold", "orbit radius=8 speed=2"])
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_setpoints_beside_ours_are_noticed(
    autopilot: str, command: str, rate_hz: float, within_s: float
) -> None:
    flight = airborne(autopilot)
    flight.command(command)
    flight.run(6.0)
    flight.vehicle.repeat(velocity_setpoint(1.0, 0.0, 0.0), rate_hz, source=STATION)
    assert flight.state.foreign_setpoint is None
    assert flight.run_until(lambda: flight.state.foreign_setpoint, within_s)
    found = flight.state.foreign_setpoint
    assert known(found).followed.startswith("north 1.00 m/s")


FLIGHT = (
    ("takeoff 1.5", 20.0),
    ("hold duration=3", 10.0),
    ("goto forward=6 right=3 altitude=5", 30.0),
    ("orbit radius=4 speed=2 laps=1", 40.0),
    ("follow-path 0,0 8,0,6 8,8,3", 40.0),
    ("figure-eight radius=4", 60.0),
    ("hold", 4.0),
    ("rtl", 90.0),
)


@pytest.mark.parametrize("autopilot", ["1.14", "1.16", "1.18", "ardupilot"])
def test_no_phase_of_a_flight_alone_is_another_commander(autopilot: str) -> None:
    options = {"autopilot": "ardupilot"} if autopilot == "ardupilot" else {"px4": autopilot}
    rates_hz = {name: hz for name, hz in RATES_HZ.items() if autopilot != "1.14" or name != "CURRENT_MODE"}
    vehicle = LockstepVehicle({"onboard": rates_hz}, seed=2, wind_mps=3.0, gusts_mps=0.6, **options)
    flight = LockstepFlight(SimulatedDriver(vehicle), plain_settings())
    assert flight.run_until(lambda: flight.state.ready_to_arm, 60.0)
    for command, limit_s in FLIGHT:
        log = flight.fly(command, limit_s)
        assert log.outcome is None or log.outcome.success, (command, log.outcome)
    assert flight.state.foreign_setpoint is None


def test_single_reposition_does_not_end_command() -> None:
    flight = airborne("ardupilot")
    flight.command("orbit radius=8 speed=2")
    flight.run(6.0)
    state = flight.state
    message = dialect.MAVLink_command_int_message(
        1, 1, 5, dialect.MAV_CMD_DO_REPOSITION, 0, 0, -1.0, 1.0, 0.0, 0.0,
        round(state.latitude_deg * 1e7) + 3000, round(state.longitude_deg * 1e7), state.altitude_amsl_m,
    )  # fmt: skip
    flight.vehicle.send(message, source=STATION)
    flight.run(6.0)
    assert flight.guidance.busy
    assert flight.guidance.phase is Phase.OFFBOARD


@pytest.mark.parametrize("autopilot", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_flight_in_gusts_counts_as_following(autopilot: str) -> None:
    """The largest lasting residual is far below the threshold."""
    flight = LockstepFlight.airborne(seed=4, height_m=6.0, wind_mps=3.0, gusts_mps=0.6, autopilot=autopilot)
    for command in ("goto forward=20 right=10 speed=4", "orbit radius=6 speed=2", "hold"):
        flight.command(command)
        flight.run(8.0)
    assert not [event for event in flight.events if event.kind is EventKind.LOST]
