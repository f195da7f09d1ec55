"""A vehicle in real time: UDP links, the camera in its own process, the truth on record.

One thread, one loop: wait for the sockets until the next physics step is due, take in what came, step, send.
Rendering happens in a process of its own and is never waited for.
"""

from __future__ import annotations

import json
import logging
import selectors
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from mavlink_sim.endpoint import UdpEndpoint
from mavlink_sim.streams import GCS_RATES_HZ
from mavlink_sim.vehicle import STEP_S, Vehicle
from vision.shared_frame import segment_path

if TYPE_CHECKING:
    from mavlink_sim.camera_process import CameraProcess
    from mavlink_sim.physics import Vector
    from mavlink_sim.world import World

logger = logging.getLogger(__name__)

TRUTH_RATE_HZ = 20.0
# After a stall longer than this the simulation does not race to catch up, it lets the time go.
MAX_BACKLOG_S = 0.25
CAMERA_CHECK_S = 0.5


@dataclass(frozen=True)
class SimulationOptions:
    """What `mavlink-sim` can be told; the command line's options have the same names and defaults.

    Attributes:
        onboard_port, gcs_port: UDP ports the vehicle sends to at first.
        onboard_bind, gcs_bind: UDP ports it binds; 0 chooses free ones.
        wind_mps: steady wind; seed chooses its direction, the gusts and the world.
        camera: name of the shared-memory segment the camera's frames go to; None for no camera.
        truth: file for the truth, one JSON object a line; None for none.
        speed: simulated seconds per real second.
        parameters: PX4 parameters that differ from the defaults.
        gimbal: with a two-axis gimbal (gimbal protocol version 2).
    """

    host: str = "127.0.0.1"
    onboard_port: int = 14540
    onboard_bind: int = 14580
    gcs_port: int = 14550
    gcs_bind: int = 18570
    system_id: int = 1
    seed: int = 0
    wind_mps: float = 0.0
    camera: str | None = None
    camera_rate_hz: float = 30.0
    truth: Path | None = None
    speed: float = 1.0
    parameters: dict[str, float] = field(default_factory=dict)
    gimbal: bool = False


class Simulation:
    """One vehicle running in real time. Use as a context manager; `run` returns after `stop`.

    Raises (when made):
        PortInUseError: a port to bind is taken.
        OSError: the truth file cannot be written.
    """

    def __init__(self, options: SimulationOptions, on_event: Callable[[str], None]) -> None:
        self.options = options
        self.vehicle = Vehicle(
            system_id=options.system_id,
            seed=options.seed,
            wind_mps=options.wind_mps,
            parameters=options.parameters,
            gimbal=options.gimbal,
            on_event=on_event,
        )
        self.vehicle.clock_ns = self._clock_ns
        self._stopped = False
        self._started_ns = time.monotonic_ns()
        self._simulated_s = 0.0
        self._next_truth_s = 0.0
        self._next_frame_s = 0.0
        self._on_event = on_event
        self._camera: CameraProcess | None = None
        self._camera_seen = False
        self._next_camera_check_s = 0.0
        self._world: World | None = None
        self._truth: IO[str] | None = None
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
            if options.truth is not None:
                self._truth = self._resources.enter_context(options.truth.open("w", encoding="utf-8"))
            if options.camera is not None or options.truth is not None:
                self._open_world()
        except BaseException:
            self._resources.close()
            raise

    def _open(self, bind: int, port: int) -> UdpEndpoint:
        endpoint = UdpEndpoint(self.options.host, bind, port, self.options.system_id)
        self._resources.callback(endpoint.close)
        return endpoint

    def _open_world(self) -> None:
        # imported here: a vehicle without camera or truth needs neither the renderer nor its start-up time
        from mavlink_sim.world import demo_world

        self._world = demo_world(self.options.seed)
        if self.options.camera is None:
            return
        from mavlink_sim.camera_process import CameraProcess

        segment_path(self.options.camera)  # raises for a name that cannot be
        self._camera = CameraProcess(
            self._world, rate_hz=self.options.camera_rate_hz, shared_name=self.options.camera
        )
        self._resources.callback(self._camera.stop)
        self._camera.start()

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        self._resources.close()

    def stop(self) -> None:
        """Make `run` return soon; may be called from a signal handler."""
        self._stopped = True

    def _clock_ns(self) -> int:
        """Time since the vehicle's boot at this very moment, between the physics steps too."""
        return int((time.monotonic_ns() - self._started_ns) * self.options.speed)

    def run(self) -> None:
        """Run until `stop`."""
        speed = self.options.speed
        self._started_ns = time.monotonic_ns() - int(self._simulated_s / speed * 1e9)
        with selectors.DefaultSelector() as selector:
            for name, endpoint in self.endpoints.items():
                selector.register(endpoint, selectors.EVENT_READ, name)
            while not self._stopped:
                behind = self._clock_ns() / 1e9 - self._simulated_s
                if behind > MAX_BACKLOG_S * max(speed, 1.0):
                    logger.warning("the simulation lost %.2f s: the machine is too busy", behind)
                    self._started_ns += int((behind - STEP_S) / speed * 1e9)
                    behind = STEP_S
                ready = selector.select(max((STEP_S - behind) / speed, 0.0))
                for key, _ in ready:
                    self._receive(key.data)
                self._advance()

    def _receive(self, name: str) -> None:
        for message in self.endpoints[name].receive():
            self.vehicle.handle(name, message)
        self._flush()

    def _flush(self) -> None:
        for name, endpoint in self.endpoints.items():
            outgoing = self.vehicle.outgoing(name)
            if outgoing:
                endpoint.send(outgoing)

    def _advance(self) -> None:
        """The physics steps that are due; at most a few, so that the sockets are never left waiting long."""
        due = self._clock_ns() / 1e9 - self._simulated_s
        steps = min(int(due / STEP_S), max(4, int(4 * self.options.speed)))
        for _ in range(steps):
            self.vehicle.step(STEP_S)
            self._simulated_s += STEP_S
        if steps:
            self._flush()
            self._show()

    def _show(self) -> None:
        """The pose to the camera and the truth to its file, each at its rate."""
        camera = self._camera
        if camera is not None and self._simulated_s >= self._next_frame_s:
            period_s = self.options.speed / self.options.camera_rate_hz  # the rate is one of real time
            self._next_frame_s = max(self._next_frame_s + period_s, self._simulated_s)
            camera.send_pose(self.vehicle.airframe.position, self.vehicle.quaternion, time.monotonic_ns())
            if self._simulated_s >= self._next_camera_check_s:
                self._next_camera_check_s = self._simulated_s + CAMERA_CHECK_S
                self._check_camera(camera)
        if self._truth is not None and self._simulated_s >= self._next_truth_s:
            self._next_truth_s += 1.0 / TRUTH_RATE_HZ
            self._truth.write(json.dumps(self.truth()) + "\n")
            self._truth.flush()

    def _check_camera(self, camera: CameraProcess) -> None:
        """Say when the camera begins and when it is lost; the vehicle flies on without it."""
        if not camera.alive:
            self._camera = None
            self._on_event(f"camera {camera.shared_name} is lost: its process ended")
        elif not self._camera_seen and segment_path(camera.shared_name).exists():
            self._camera_seen = True
            self._on_event(f"camera {camera.shared_name} is on")

    def truth(self) -> dict[str, Any]:
        """What is really so now: pose, mode, and the range to every object of the world."""
        airframe, autopilot = self.vehicle.airframe, self.vehicle.autopilot
        return {
            "stamp_ns": time.monotonic_ns(),
            "position_ned_m": [round(value, 4) for value in airframe.position],
            "velocity_ned_mps": [round(value, 4) for value in airframe.velocity],
            "yaw_rad": round(airframe.yaw_rad, 5),
            "mode": autopilot.mode.name,
            "armed": autopilot.armed,
            "landed": autopilot.landed,
            "objects": [] if self._world is None else _object_truth(self._world, airframe.position),
        }


def _object_truth(world: World, position_ned_m: Vector) -> list[dict[str, Any]]:
    from mavlink_sim.world import range_to

    return [
        {
            "identifier": thing.identifier,
            "class_name": thing.class_name,
            "position_ned_m": [round(float(value), 3) for value in thing.position_ned_m],
            "range_m": round(float(range_to(thing, position_ned_m)), 3),
        }
        for thing in world.objects
    ]
