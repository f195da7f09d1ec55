"""A vehicle in real time: UDP links, the camera in its own process, the truth file.

One thread, one loop: wait for the sockets until the next physics step is due, process messages, step, send.
"""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from mavlink_sim.faults.injector import fault_injector
from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.realtime.sim_outputs import SimOutputs, loaded_scene
from mavlink_sim.vehicles.firmware import vehicle_class
from mavlink_sim.vehicles.fleet_world import FleetWorld
from mavlink_sim.vehicles.vehicle import STEP_S
from mavlink_sim.wire.endpoint import UdpEndpoint
from mavlink_sim.wire.streams import GCS_RATES_HZ
from mavlink_sim.wire.traffic_log import recording

PACE_PERIOD_S = 5.0

# After a stall longer than this the simulation does not catch up but drops the time.
MAX_BACKLOG_S = 0.25


class Simulation:
    """One vehicle running in real time. Use as a context manager; `run_together` runs it.

    Args:
        fleet_world: the vehicles of its fleet; None: it is alone.

    Raises (when made):
        PortInUseError: a port to bind is taken.
        FaultError: an invalid fault. ControlError: the control endpoint cannot be opened.
        SceneError: the scene cannot be used. ValueError: invalid options, or an obstacle at its start.
        OSError: the truth file or the record cannot be written.
    """

    def __init__(
        self,
        options: SimulationOptions,
        on_event: Callable[[str], None],
        fleet_world: FleetWorld | None = None,
    ) -> None:
        self.options = options
        scene = loaded_scene(options)
        self.vehicle = vehicle_class(options.autopilot)(
            system_id=options.system_id,
            seed=options.seed,
            air_seed=options.world_seed,
            wind_mps=options.wind_mps,
            gusts_mps=options.gusts_mps,
            parameters=options.parameters,
            ready_after_s=options.ready_after_s,
            px4=options.px4,
            noise=options.noise,
            start_ned_m=options.start_ned_m,
            scene=None if options.scene is None else scene,
            obstacle_sensor=options.obstacle_sensor,
            gimbal=options.gimbal,
            on_event=on_event,
        )
        self.vehicle.clock_ns = self._boot_clock_ns
        self.vehicle.utc_ns = time.time_ns
        self._started_ns = time.monotonic_ns()
        self._simulated_s = 0.0
        self._resources = ExitStack()
        try:
            self.endpoints = {
                name: self._open(bind, port)
                for name, bind, port in (
                    ("onboard", options.onboard_bind, options.onboard_port),
                    ("gcs", options.gcs_bind, options.gcs_port),
                )
            }
            self.vehicle.add_link("onboard")
            self.vehicle.add_link("gcs", GCS_RATES_HZ)
            for name, endpoint in self.endpoints.items():
                endpoint.signing = self.vehicle.links[name].signing
            if options.signing_key is not None:
                self.vehicle.sign_everything(options.signing_key)
            if options.record is not None:
                files = {f"{name}-{options.system_id}": link for name, link in self.endpoints.items()}
                self._resources.enter_context(recording(files, options.record))
            self._faults = self._resources.enter_context(
                fault_injector(self.vehicle.faults, options.system_id, self.endpoints, options, on_event)
            )
            fleet_world = FleetWorld(1) if fleet_world is None else fleet_world
            fleet_world.join(self.vehicle)
            self._outputs = SimOutputs(self.vehicle, scene, fleet_world, options, on_event, self._resources)
        except BaseException:
            self._resources.close()
            raise

    def _open(self, bind: int, port: int) -> UdpEndpoint:
        endpoint = UdpEndpoint(self.options.host, bind, port, self.options.system_id)
        self._resources.callback(endpoint.close)
        return endpoint

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        self._resources.close()

    @property
    def speed(self) -> float:
        """Simulated seconds per second."""
        return self.options.speed

    def _clock_ns(self, now_ns: int | None = None) -> int:
        """Simulated time, ns, at a monotonic time, by default now; continuous between the physics steps."""
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        return int((now_ns - self._started_ns) * self.options.speed)

    def _boot_clock_ns(self) -> int:
        """The same since the vehicle's boot, without the time of stalls."""
        return self._clock_ns() - (self.vehicle.faults.elapsed_us - self.vehicle.boot_us) * 1000

    def start_clock(self, now_ns: int) -> None:
        """Start the clock at a monotonic time."""
        self._started_ns = now_ns - int(self._simulated_s / self.options.speed * 1e9)

    def backlog(self) -> float:
        """Simulated seconds too far behind the clock to catch up; 0 normally."""
        behind = self._clock_ns() / 1e9 - self._simulated_s
        return behind - STEP_S if behind > MAX_BACKLOG_S * max(self.options.speed, 1.0) else 0.0

    def let_go(self, lost_s: float) -> None:
        """Drop simulated seconds instead of catching up."""
        self._started_ns += int(lost_s / self.options.speed * 1e9)

    def until_next_step(self) -> float:
        """Real seconds until the next step is due."""
        behind = self._clock_ns() / 1e9 - self._simulated_s
        return max((STEP_S - behind) / self.options.speed, 0.0)

    def receive(self, name: str) -> None:
        """Process the messages received on a link, and send the answers."""
        for message in self.endpoints[name].receive():
            self.vehicle.handle(name, message)
        self.flush()

    def flush(self) -> None:
        for name, endpoint in self.endpoints.items():
            outgoing = self.vehicle.outgoing(name)
            if outgoing:
                endpoint.send(outgoing)

    def steps_due(self, now_ns: int) -> int:
        """The number of physics steps due at a monotonic time.

        At most a few, so that the sockets are served often. Vehicles with the same clock and the same times
        are always at the same simulated time.
        """
        due = self._clock_ns(now_ns) / 1e9 - self._simulated_s
        return min(int(due / STEP_S), max(4, int(4 * self.options.speed)))

    def step(self) -> None:
        """Take one physics step, and deliver datagrams delayed by link faults."""
        self.vehicle.step(STEP_S)
        self._simulated_s += STEP_S
        for name in self._faults.delivered():
            self.receive(name)

    def settle(self, *, stepped: bool) -> None:
        """Send the messages of the steps, if there were any, and process fault commands."""
        if stepped:
            self.flush()
        self._faults.poll()

    def show(self, now_ns: int) -> None:
        """Send the pose to the camera and write the truth, each at its rate, with this stamp."""
        self._outputs.show(self._simulated_s, now_ns)

    def truth(self) -> dict[str, Any]:
        """The current truth: pose, mode, and the range to every object and vehicle."""
        return self._outputs.truth(self._simulated_s, time.monotonic_ns())


class _Pace:
    """Reports, every few seconds, that the machine is too slow for the requested speed."""

    def __init__(self, speed: float, on_event: Callable[[str], None]) -> None:
        self._speed = speed
        self._on_event = on_event
        self._lost_s = 0.0
        self._since_s = time.monotonic()

    def lose(self, simulated_s: float) -> None:
        self._lost_s += simulated_s

    def report(self) -> None:
        passed_s = time.monotonic() - self._since_s
        if passed_s < PACE_PERIOD_S:
            return
        if self._lost_s > 0.01 * self._speed * passed_s:
            reached = self._speed - self._lost_s / passed_s
            self._on_event(
                f"cannot keep up: {reached:.2f} times real time in the last {passed_s:.0f} s, "
                f"not {self._speed:g}; the machine is too busy"
            )
        self._lost_s = 0.0
        self._since_s += passed_s


def run_together(
    simulations: Sequence[Simulation],
    stopped: Callable[[], bool],
    on_event: Callable[[str], None],
) -> None:
    """The loop: wait for the sockets until the next step is due, process messages, step, send."""
    first = simulations[0]
    speed = first.speed
    pace = _Pace(speed, on_event)
    started_ns = time.monotonic_ns()
    for simulation in simulations:
        simulation.start_clock(started_ns)
    with selectors.DefaultSelector() as selector:
        for simulation in simulations:
            for name, endpoint in simulation.endpoints.items():
                selector.register(endpoint, selectors.EVENT_READ, (simulation, name))
        while not stopped():
            lost_s = first.backlog()
            if lost_s > 0.0:
                pace.lose(lost_s)
                for simulation in simulations:
                    simulation.let_go(lost_s)
            pace.report()
            for key, _ in selector.select(first.until_next_step()):
                simulation, name = key.data
                simulation.receive(name)
            # one time for all, so that cameras show all of them at one simulated time
            now_ns = time.monotonic_ns()
            steps = first.steps_due(now_ns)
            for _ in range(steps):
                for simulation in simulations:
                    simulation.step()
            for simulation in simulations:
                simulation.settle(stepped=steps > 0)
            if steps:
                for simulation in simulations:
                    simulation.show(now_ns)
