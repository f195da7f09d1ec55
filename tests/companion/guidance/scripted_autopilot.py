"""A working dummy of a driver: PX4's modes and landed states in memory, and a clock that tests turn."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace

from kinematic_vehicle import KinematicVehicle

from companion.guidance.battery import NO_MINIMUM, BatteryMinimum
from companion.guidance.behaviour import Behaviour, Outcome, Situation
from companion.guidance.envelope import Envelope
from companion.guidance.hold import HoldBehaviour
from companion.guidance.pilot import Pilot
from companion.guidance.pilot_event import PilotEvent, PilotEventKind
from companion.vehicle.driver import CommandRefusedError, SystemStatus
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.streamer import Streamer

CLIMB_MPS = 1.5
DISARM_AFTER_LANDING_S = 2.0


class ScriptedAutopilot:
    """Implements `Driver`. Modes show `lag_s` after they changed, as a HEARTBEAT does."""

    def __init__(self, vehicle: KinematicVehicle, lag_s: float = 0.0) -> None:
        self.vehicle = vehicle
        self.lag_s = lag_s
        self.refuse: dict[FlightMode, str] = {}
        self.linked = True
        self.failsafe = False
        self.position_alive = True
        self.battery_fraction: float | None = 0.9
        self.battery_alive = True
        self._battery_ns = vehicle.now_ns
        self.takeoff_short_m = 0.0
        self.requests: list[str] = []
        self.setpoints: list[Setpoint] = []
        self._shown = (vehicle.armed, vehicle.mode)
        self._changes: list[tuple[int, tuple[bool, FlightMode]]] = []
        self._takeoff_m = 0.0
        self._landed_ns: int | None = None
        self._mode_before_landing = vehicle.mode
        self._heartbeat_ns = vehicle.now_ns
        self._position_ns = vehicle.now_ns
        self._callbacks: list[Callable[[VehicleState], None]] = []

    async def connect(self, timeout_s: float) -> None:
        self.linked = True

    async def close(self) -> None:
        self.linked = False

    @property
    def state(self) -> VehicleState:
        armed, mode = self._shown
        return replace(
            self.vehicle.state,
            heartbeat_ns=self._heartbeat_ns,
            position_ns=self._position_ns,
            attitude_ns=self._position_ns,
            armed=armed,
            mode=mode,
            failsafe=self.failsafe,
            battery_fraction=self.battery_fraction,
            battery_ns=self._battery_ns,
        )

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback)

    async def arm(self) -> None:
        self.requests.append("arm")
        self.vehicle.armed = True
        await self._until(lambda: self._shown[0])

    async def disarm(self) -> None:
        self.requests.append("disarm")
        self.vehicle.armed = False
        await self._until(lambda: not self._shown[0])

    async def set_mode(self, mode: FlightMode, *, timeout_s: float = 3.0) -> None:
        self.requests.append(mode.value)
        if mode in self.refuse:
            raise CommandRefusedError(self.refuse[mode])
        self.change_mode(mode)
        await self._until(lambda: self._shown[1] is mode)

    async def takeoff(self, altitude_m: float) -> None:
        self.requests.append(f"takeoff {altitude_m:g}")
        self._takeoff_m = altitude_m
        self.change_mode(FlightMode.TAKEOFF)

    def send_setpoint(self, setpoint: Setpoint) -> None:
        self.setpoints.append(setpoint)

    def send_heartbeat(self, status: SystemStatus) -> None:
        pass

    async def get_parameter(self, name: str) -> float:
        raise CommandRefusedError(f"no parameter {name}")

    async def set_parameter(self, name: str, value: float) -> None:
        raise CommandRefusedError(f"no parameter {name}")

    def change_mode(self, mode: FlightMode) -> None:
        """By us or by a pilot: the vehicle does not tell them apart."""
        if mode is FlightMode.LAND and self.vehicle.mode is not FlightMode.LAND:
            self._mode_before_landing = self.vehicle.mode
        self.vehicle.mode = mode

    def step(self, dt_s: float) -> None:
        """Fly on, and let what changed show after the lag."""
        vehicle, dt_ns = self.vehicle, round(dt_s * 1e9)
        altitude = -vehicle.position[2]
        still = Setpoint.brake(vehicle.now_ns)
        if vehicle.mode is FlightMode.OFFBOARD and vehicle.armed and self.setpoints:
            vehicle.fly(self.setpoints[-1], dt_s)
        elif vehicle.mode is FlightMode.TAKEOFF and vehicle.armed:
            vehicle.landed = LandedState.TAKING_OFF
            vehicle.fly(Setpoint.velocity((0, 0, -CLIMB_MPS), vehicle.now_ns), dt_s)
            if altitude >= self._takeoff_m - self.takeoff_short_m - 0.3:
                vehicle.mode, vehicle.landed = FlightMode.HOLD, LandedState.IN_AIR
        elif vehicle.mode in (FlightMode.LAND, FlightMode.RETURN) and altitude > 0.0:
            vehicle.landed = LandedState.LANDING
            vehicle.fly(Setpoint.velocity((0, 0, 1.0), vehicle.now_ns), dt_s)
        elif vehicle.landed is LandedState.IN_AIR:
            vehicle.fly(still, dt_s)
        else:
            vehicle.now_ns += dt_ns
        if vehicle.landed is LandedState.LANDING and vehicle.position[2] >= 0.0:
            vehicle.landed, self._landed_ns = LandedState.ON_GROUND, vehicle.now_ns
        if self._landed_ns and vehicle.now_ns - self._landed_ns > DISARM_AFTER_LANDING_S * 1e9:
            vehicle.armed, vehicle.mode, self._landed_ns = False, self._mode_before_landing, None
        self._changes.append((vehicle.now_ns, (vehicle.armed, vehicle.mode)))
        while self._changes and vehicle.now_ns - self._changes[0][0] >= self.lag_s * 1e9:
            self._shown = self._changes.pop(0)[1]
        if self.linked:
            self._heartbeat_ns = vehicle.now_ns
            if self.position_alive:
                self._position_ns = vehicle.now_ns
            if self.battery_alive:
                self._battery_ns = vehicle.now_ns
        for callback in list(self._callbacks):
            callback(self.state)

    async def _until(self, shown: Callable[[], bool]) -> None:
        start_ns = self.vehicle.now_ns
        while not shown():
            if self.vehicle.now_ns - start_ns > 3e9:
                raise CommandRefusedError(f"it did not show in 3 s: {self._shown[1].value} mode")
            await asyncio.sleep(0)


class Cockpit:
    """The service's loop in lockstep: autopilot, streamer, guidance, 50 times a second of a turned clock."""

    def __init__(
        self,
        vehicle: KinematicVehicle,
        lag_s: float = 0.0,
        class_names: tuple[str, ...] | None = None,
        battery: BatteryMinimum = NO_MINIMUM,
    ) -> None:
        self.autopilot = ScriptedAutopilot(vehicle, lag_s)
        self.events: list[PilotEvent] = []
        self.streamer = Streamer(self.autopilot.send_setpoint, clock_ns=lambda: vehicle.now_ns)
        self.pilot = Pilot(
            self.autopilot,
            self.streamer,
            Envelope(),
            on_event=self.events.append,
            class_names=lambda: class_names,
            battery=battery,
        )
        self.vehicle = vehicle
        self.streaming = True
        self.perception_age_s: float | None = 0.05

    async def turn(self, seconds: float = 0.02) -> None:
        for _ in range(max(1, round(seconds / 0.02))):
            self.autopilot.step(0.02)
            # Tasks that were started or waited for get their turn.
            for _ in range(4):
                await asyncio.sleep(0)
            age_s = self.perception_age_s
            self.pilot.update(
                Situation(
                    self.vehicle.now_ns,
                    self.autopilot.state,
                    (),
                    age_s,
                    age_s is not None and age_s < 0.5,
                )
            )
            if self.streaming:
                self.streamer.tick(self.vehicle.now_ns)

    async def until(self, condition: Callable[[], bool], seconds: float = 60.0) -> None:
        for _ in range(round(seconds / 0.02)):
            if condition():
                return
            await self.turn()
        raise AssertionError(
            f"it did not happen in {seconds} s of flight: {[e.message for e in self.events]}"
        )

    async def outcome(self, future: asyncio.Future[Outcome], seconds: float = 120.0) -> Outcome:
        await self.until(future.done, seconds)
        return future.result()


def flying(mode: FlightMode = FlightMode.HOLD) -> KinematicVehicle:
    """In the air."""
    return KinematicVehicle(mode=mode)


def parked(mode: FlightMode = FlightMode.HOLD) -> KinematicVehicle:
    """On the ground, disarmed."""
    return KinematicVehicle(position=[0.0, 0.0, 0.0], mode=mode, armed=False, landed=LandedState.ON_GROUND)


async def engaged(cockpit: Cockpit, behaviour: Behaviour | None = None) -> asyncio.Future[Outcome]:
    """Flying a behaviour in OFFBOARD."""
    await cockpit.turn(0.1)
    future = cockpit.pilot.command(behaviour or HoldBehaviour())
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard", 5.0)
    await cockpit.turn(0.5)
    return future


def kinds(cockpit: Cockpit) -> list[PilotEventKind]:
    """What the pilot has told of, in order."""
    return [event.kind for event in cockpit.events]
