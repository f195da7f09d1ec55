"""Whatever we request, over whatever link: the last mode is the pilot's.

Every sender of modes, with each fault of the link, and a pilot who changes the mode at each moment of the
request, in lockstep. `test_mode_changes` has the rules one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import pytest

from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.bench.simulated_driver import RATES_HZ, SimulatedDriver
from companion.guidance.interface import Request, SetMode
from companion.guidance.mode_control import Phase
from companion.service.guidance_loop import mode_at_shutdown
from companion.vehicle.state import FlightMode, VehicleState
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.px4.modes import Mode
from tests.companion.guidance.guidance_harness import mission

EVERY_S = 0.05
# A change of the mode is not reported sooner after another one. What ours overrides meanwhile, nobody knows.
REPORT_PERIOD_S = {"1.14": 1.0, "1.15": 0.1, "1.17": 0.1, "ardupilot": 0.2}  # of HEARTBEAT, CURRENT_MODE
PILOTS = ("POSCTL", "LOITER")  # PX4's, ArduPilot's
SHUTDOWN = 99  # identifier of its request
FENCE = {"GF_ACTION": 2.0, "GF_MAX_HOR_DIST": 14.0}


@dataclass(frozen=True)
class Sender:
    """One sender of modes.

    Attributes:
        prepare: before the fault of the link. ready: with it, until shortly before the request.
        begin: requests. round_trips, more_s: how long that takes.
    """

    prepare: Callable[[LockstepFlight], None]
    begin: Callable[[LockstepFlight], None]
    round_trips: int = 1
    more_s: float = 0.4
    ready: Callable[[LockstepFlight], None] = lambda flight: None


def nothing(flight: LockstepFlight) -> None:
    """The flight is in HOLD."""


def engage(flight: LockstepFlight) -> None:
    flight.command("hold")
    assert flight.run_until(lambda: flight.guidance.phase is Phase.OFFBOARD, 10.0)
    flight.run(0.5)


def approach_fence(flight: LockstepFlight) -> None:
    for name, value in FENCE.items():
        flight.vehicle.vehicle.parameters.set(name, value)
    flight.command("goto 45 0")
    assert flight.run_until(lambda: flight.vehicle.truth.position_ned_m[0] > 3.0, 30.0)


def breach(flight: LockstepFlight) -> None:
    assert flight.run_until(lambda: flight.vehicle.truth.mode == "HOLD", 30.0)


def shut_down(flight: LockstepFlight) -> None:
    """As `GuidanceLoop.shut_down`."""
    mode = mode_at_shutdown(flight.state, flight.guidance.phase, flight.streamer.state)
    flight.step(ending=True)
    if mode is not None:
        flight.driver.start(Request(SHUTDOWN, SetMode(mode), flight.now_ns + 8_000_000_000))


def by(text: str) -> Callable[[LockstepFlight], None]:
    def command(flight: LockstepFlight) -> None:
        flight.command(text)

    return command


def start_mission(flight: LockstepFlight) -> None:
    flight.command(mission(flight, "hold 0.5", "land"))


def end_soon(flight: LockstepFlight) -> None:
    """A shutdown while OFFBOARD is being requested."""
    flight.command("hold")
    flight.run(0.15)
    shut_down(flight)


SENDERS = {
    "takeoff": Sender(nothing, by("takeoff 3"), round_trips=2, more_s=1.0),
    "goto": Sender(nothing, by("goto 20 0")),
    "stop": Sender(engage, by("stop")),
    "land": Sender(engage, by("land")),
    "rtl": Sender(engage, by("rtl")),
    "land-from-hold": Sender(nothing, by("land")),
    "mission": Sender(nothing, start_mission, round_trips=2, more_s=1.2),
    "yield": Sender(approach_fence, nothing, more_s=1.5, ready=breach),
    "shutdown": Sender(engage, shut_down),
    "shutdown-engaging": Sender(nothing, end_soon),
}
FAULTS = {
    "none": ([], 0.0),
    "acknowledgements lost": (["lost_ack"], 0.0),
    "requests lost": (["packet_loss 0.6 way=in"], 0.0),
    "delay 0.1": (["link_delay 0.1"], 0.1),
    "delay 0.3": (["link_delay 0.3"], 0.3),
    "delay 1": (["link_delay 1"], 1.0),
    "duplicates": (["duplicate 1", "link_delay 0.1"], 0.1),
}


def new_vehicle(autopilot: str) -> LockstepVehicle:
    """PX4 of a release, or an ArduPilot. PX4 1.14 has no CURRENT_MODE."""
    if autopilot == "ardupilot":
        return LockstepVehicle({"onboard": {}}, seed=3, autopilot=autopilot)
    rates_hz = {name: hz for name, hz in RATES_HZ.items() if autopilot != "1.14" or name != "CURRENT_MODE"}
    # Another end of OFFBOARD than the pilot's mode.
    return LockstepVehicle({"onboard": rates_hz}, seed=3, px4=autopilot, parameters={"COM_OBL_RC_ACT": 5.0})


@cache
def parked(autopilot: str) -> LockstepVehicle:
    vehicle = new_vehicle(autopilot)
    vehicle.step(8.0)
    vehicle.receive()
    return vehicle


@cache
def airborne(autopilot: str) -> LockstepVehicle:
    vehicle = new_vehicle(autopilot)
    vehicle.take_off(6.0, limit_s=90.0)
    vehicle.receive()
    return vehicle


class PilotedFlight:
    """One flight with one change of the pilot.

    Attributes:
        reported: modes as they were reported, in order. overridden_s: how long the pilot's lasted.
    """

    def __init__(self, sender: str, fault: str, autopilot: str) -> None:
        self.sender, (commands, self.delay_s) = SENDERS[sender], FAULTS[fault]
        vehicle = (parked if sender == "takeoff" else airborne)(autopilot).copy()
        self.flight = LockstepFlight.of_vehicle(vehicle, settings=plain_settings())
        self.flight.run(0.3)
        self.sender.prepare(self.flight)
        for command in commands:
            vehicle.vehicle.faults.begin(command)
        self.flight.run(2 * self.delay_s + 0.2)
        self.sender.ready(self.flight)
        # A lost acknowledgement cannot show that ours has arrived after a change that was not read yet.
        self.read_at_once = "lost_ack" in commands
        self.reported: list[FlightMode] = []
        self.overridden_s: float | None = None
        self._changed_s: float | None = None
        driver = self.flight.driver
        assert isinstance(driver, SimulatedDriver)
        on_report, step = driver._changes.on_report, driver.step

        def note(state: VehicleState, now_ns: int, answered_ns: int) -> None:
            if self.reported[-1:] != [state.mode]:
                self.reported.append(state.mode)
            on_report(state, now_ns, answered_ns)

        def watched(dt_s: float) -> None:
            step(dt_s)
            changed = self._changed_s is not None and vehicle.truth.mode not in PILOTS
            if changed and self.overridden_s is None:
                self.overridden_s = vehicle.now_s - (self._changed_s or 0.0)

        driver._changes.on_report = note  # type: ignore[method-assign]
        driver.step = watched  # type: ignore[method-assign]

    def fly(self, pilot_s: float) -> str:
        """The pilot changes the mode so long after the request; 0: just before it. Returns the last mode."""
        if not pilot_s:
            self._pilot()
        self.sender.begin(self.flight)
        if pilot_s:
            self._run(pilot_s)
            self._pilot()
        self._run(3.0 + 4 * self.delay_s)
        return self.flight.vehicle.truth.mode

    def unreported(self, period_s: float) -> bool:
        """Whether ours overrode the pilot's mode before it was reported."""
        unseen = FlightMode.POSITION not in self.reported
        return unseen and self.overridden_s is not None and self.overridden_s <= period_s

    def _pilot(self) -> None:
        self._changed_s = self.flight.vehicle.now_s
        self.flight.vehicle.vehicle.autopilot.pilot_takes_over(Mode.POSCTL)
        # Until it is reported. A change that ours overrides within these 4 ms is known to nobody.
        step = self.flight.driver.step if self.read_at_once else self.flight.vehicle.step
        step(0.004)

    def _run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            self.flight.tick()


def moments(sender: str, fault: str, every_s: float) -> list[float]:
    """Of a pilot's change, from just before the request until its effect was reported."""
    course_s = SENDERS[sender].more_s + 2 * FAULTS[fault][1] * SENDERS[sender].round_trips
    return [number * every_s for number in range(round(course_s / every_s) + 1)]


def overridden(
    sender: str, fault: str, moments_s: list[float], autopilot: str = "1.17"
) -> list[tuple[float, str, list[str]]]:
    """The moments of a pilot's change after which the mode is another one, with the reported modes."""
    found = []
    for pilot_s in moments_s:
        if not pilot_s and fault == "acknowledgements lost":
            continue  # without them, our mode may as well be the pilot's own choice
        flight = PilotedFlight(sender, fault, autopilot)
        mode = flight.fly(pilot_s)
        if mode not in PILOTS and not flight.unreported(REPORT_PERIOD_S[autopilot]):
            found.append((pilot_s, mode, [str(mode) for mode in flight.reported]))
    return found


@pytest.mark.parametrize("fault", ["none", "requests lost", "delay 0.3", "delay 1", "duplicates"])
@pytest.mark.parametrize("sender", SENDERS)
def test_last_mode_is_the_pilots(sender: str, fault: str) -> None:
    delay_s = FAULTS[fault][1]
    assert overridden(sender, fault, [0.0, 0.1 + delay_s / 2, 0.15 + 1.5 * delay_s]) == []


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", REPORT_PERIOD_S)
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("sender", SENDERS)
def test_last_mode_is_the_pilots_at_each_moment(sender: str, fault: str, autopilot: str) -> None:
    if (sender, autopilot) == ("yield", "ardupilot"):
        pytest.skip("ArduPilot's fence does not hold and keep the mode that was intended")
    assert overridden(sender, fault, moments(sender, fault, EVERY_S), autopilot) == []


def test_late_request_for_the_present_mode_is_not_the_pilots() -> None:
    """Copter is in GUIDED when GUIDED is requested: its report does not show that the message has arrived."""
    assert overridden("shutdown-engaging", "delay 0.3", [0.0, 0.1], "ardupilot") == []
