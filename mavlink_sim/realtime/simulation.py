"""A vehicle in real time: UDP links, the camera in its own process, the truth on record.

One thread, one loop: wait for the sockets until the next physics step is due, take in what came, step, send.
Rendering happens in a process of its own and is never waited for.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from mavlink_sim.faults.injector import fault_injector
from mavlink_sim.realtime.loop import run_together
from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.realtime.sim_outputs import SimOutputs, camera_turn_rad, loaded_scene
from mavlink_sim.vehicles.firmware import vehicle_class
from mavlink_sim.vehicles.fleet_world import FleetWorld
from mavlink_sim.vehicles.vehicle import STEP_S
from mavlink_sim.wire.endpoint import UdpEndpoint
from mavlink_sim.wire.streams import GCS_RATES_HZ
from mavlink_sim.wire.traffic_log import recording
from mavlink_sim.world.aircraft import identifier_offset

if TYPE_CHECKING:
    from mavlink_sim.physics.airframe import Vector

logger = logging.getLogger(__name__)

# After a stall longer than this the simulation does not race to catch up, it lets the time go.
MAX_BACKLOG_S = 0.25


class Simulation:
    """One vehicle running in real time. Use as a context manager; `run` returns after `stop`.

    Args:
        fleet_world: among whom it flies, seeing and seen; None: it is alone.

    Raises (when made):
        PortInUseError: a port to bind is taken.
        FaultError: a fault that cannot be. ControlError: the control endpoint cannot be opened.
        SceneError: the scene cannot be used. ValueError: a vehicle that cannot be, or not there.
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
        self._stopped = False
        self._started_ns = time.monotonic_ns()
        self._simulated_s = 0.0
        self._on_event = on_event
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
            fleet_world.join(self.vehicle, 0 if scene is None else identifier_offset(scene.world))
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

    def stop(self) -> None:
        """Make `run` return soon; may be called from a signal handler."""
        self._stopped = True

    @property
    def speed(self) -> float:
        """Simulated seconds in a second."""
        return self.options.speed

    def _clock_ns(self, now_ns: int | None = None) -> int:
        """Simulated time at a moment, by default this very one, between the physics steps too."""
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        return int((now_ns - self._started_ns) * self.options.speed)

    def _boot_clock_ns(self) -> int:
        """The same since the vehicle's boot, without the time that it stood still."""
        return self._clock_ns() - (self.vehicle.faults.elapsed_us - self.vehicle.boot_us) * 1000

    def run(self) -> None:
        """Run until `stop`."""
        run_together([self], lambda: self._stopped, self._on_event)

    def start_clock(self, now_ns: int) -> None:
        """From this moment (monotonic) on, time passes."""
        self._started_ns = now_ns - int(self._simulated_s / self.options.speed * 1e9)

    def backlog(self) -> float:
        """Simulated seconds that are hopelessly behind the clock, 0 in good order."""
        behind = self._clock_ns() / 1e9 - self._simulated_s
        return behind - STEP_S if behind > MAX_BACKLOG_S * max(self.options.speed, 1.0) else 0.0

    def let_go(self, lost_s: float) -> None:
        """Give up so many simulated seconds instead of racing after them."""
        self._started_ns += int(lost_s / self.options.speed * 1e9)

    def until_next_step(self) -> float:
        """Real seconds until the next step is due."""
        behind = self._clock_ns() / 1e9 - self._simulated_s
        return max((STEP_S - behind) / self.options.speed, 0.0)

    def receive(self, name: str) -> None:
        """Take in what came on a link, and answer."""
        for message in self.endpoints[name].receive():
            self.vehicle.handle(name, message)
        self.flush()

    def flush(self) -> None:
        for name, endpoint in self.endpoints.items():
            outgoing = self.vehicle.outgoing(name)
            if outgoing:
                endpoint.send(outgoing)

    def steps_due(self, now_ns: int) -> int:
        """How many physics steps are to be taken at a moment (monotonic).

        At most a few, so that the sockets are never left waiting long. Vehicles on one clock that are told
        of the same moments are always at the same simulated time.
        """
        due = self._clock_ns(now_ns) / 1e9 - self._simulated_s
        return min(int(due / STEP_S), max(4, int(4 * self.options.speed)))

    def step(self) -> None:
        """One physics step, and what a fault of the link held back until then."""
        self.vehicle.step(STEP_S)
        self._simulated_s += STEP_S
        for name in self._faults.delivered():
            self.receive(name)

    def settle(self, *, stepped: bool) -> None:
        """Send what the steps brought, if there were any, and look what faults are asked for."""
        if stepped:
            self.flush()
        self._faults.poll()

    def show(self, now_ns: int) -> None:
        """The pose to the camera and the truth to its file, each at its rate, stamped with the moment."""
        self._outputs.show(self._simulated_s, now_ns)

    @property
    def camera_turn_rad(self) -> Vector | None:
        """Roll, pitch, yaw from the body to a camera on the gimbal; None for one that sits on the body."""
        return camera_turn_rad(self.vehicle)

    def truth(self) -> dict[str, Any]:
        """What is really so now: pose, mode, and the range to every object of the world, the others too."""
        return self._outputs.truth(self._simulated_s, time.monotonic_ns())
