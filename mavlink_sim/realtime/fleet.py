"""Many vehicles in one process: each with its own system id, ports, seed and start, on one clock.

Ports and ids are as in PX4's SITL: instance i has system id 1 + i, sends to 14540 + i from 14580 + i, and to
the one ground station at 14550 from 18570 + i. PX4's instances from 10 on all send to 14549; these do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.realtime.simulation import Simulation, run_together
from mavlink_sim.vehicles.fleet_world import FleetWorld

MAX_VEHICLES = 250  # system ids are 1 to 255, and a ground station needs some


def start_positions(count: int, spacing_m: float) -> list[tuple[float, float]]:
    """Where the vehicles start, (north, east) metres: a square grid, row by row, the first at (0, 0)."""
    columns = math.ceil(math.sqrt(count))
    return [(index // columns * spacing_m, index % columns * spacing_m) for index in range(count)]


def instance_options(
    options: SimulationOptions, count: int, spacing_m: float, camera_vehicle: int = 1, cameras: int = 1
) -> list[SimulationOptions]:
    """The options of each vehicle of a fleet; `options` are the first one's.

    They share one world, wind and gusts, those of the first one's seed; noise and faults have separate seeds.
    A bind port of 0 stays 0 (a free one each). `cameras` vehicles from `camera_vehicle` (counted from 1) on
    have a camera. The first of them has the camera's name and the outputs; the names of the others end in
    their system id, as do the truth files of all vehicles but the first. Every vehicle has the faults; the
    first one has the console, each has its own zenoh key.

    Raises:
        ValueError: too many vehicles (ids, ports), or no such vehicles for the cameras.
    """
    if not 1 <= count <= MAX_VEHICLES:
        raise ValueError(f"{count} vehicles: expected 1 to {MAX_VEHICLES}")
    if not 1 <= camera_vehicle <= count:
        raise ValueError(f"camera on vehicle {camera_vehicle}: the fleet has vehicles 1 to {count}")
    with_camera = range(camera_vehicle - 1, camera_vehicle - 1 + cameras)
    if cameras < 1 or with_camera[-1] >= count:
        raise ValueError(
            f"{cameras} cameras from vehicle {camera_vehicle} on: the fleet has vehicles 1 to {count}"
        )
    if cameras > 1 and options.camera is None:
        raise ValueError(f"{cameras} cameras: expected the name of their shared memory, --camera NAME")
    if options.system_id + count - 1 > 255:
        raise ValueError(f"{count} vehicles from system id {options.system_id} on: ids end at 255")
    for name in ("onboard_port", "onboard_bind", "gcs_bind"):
        last = getattr(options, name) + count - 1
        if last > 65535:
            raise ValueError(f"{count} vehicles from --{name.replace('_', '-')} on: ports end at 65535")
    fleet = []
    for index, start in enumerate(start_positions(count, spacing_m)):
        system_id = options.system_id + index
        first_camera = index == with_camera[0]
        camera = options.camera if first_camera else f"{options.camera}-{system_id}"
        fleet.append(
            replace(
                options,
                system_id=system_id,
                seed=options.seed + index,
                world_seed=options.seed if count > 1 and options.world_seed is None else options.world_seed,
                start_ned_m=start,
                onboard_port=options.onboard_port + index,
                onboard_bind=options.onboard_bind + index if options.onboard_bind else 0,
                gcs_bind=options.gcs_bind + index if options.gcs_bind else 0,
                camera=camera if index in with_camera else None,
                camera_outputs=options.camera_outputs if first_camera else (),
                camera_truth=options.camera_truth if first_camera else None,
                console=options.console if index == 0 else False,
                truth=options.truth if index == 0 else _numbered(options.truth, system_id),
            )
        )
    return fleet


def _numbered(path: Path | None, system_id: int) -> Path | None:
    return None if path is None else path.with_stem(f"{path.stem}-{system_id}")


class Fleet:
    """Vehicles on one clock, in real time, which see each other.

    Use as a context manager; `run` returns after `stop`.

    Raises (when made): what `Simulation` raises.
    """

    def __init__(self, options: Sequence[SimulationOptions], on_event: Callable[[str], None]) -> None:
        self._resources = ExitStack()
        self._stopped = False
        self._on_event = on_event
        self.simulations: list[Simulation] = []
        self._fleet_world = FleetWorld(len(options))
        try:
            for one in options:
                on_vehicle_event = on_event if len(options) == 1 else _named(on_event, one.system_id)
                self.simulations.append(
                    self._resources.enter_context(Simulation(one, on_vehicle_event, self._fleet_world))
                )
        except BaseException:
            self._resources.close()
            raise

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *exception: object) -> None:
        self._resources.close()

    def __iter__(self) -> Iterator[Simulation]:
        return iter(self.simulations)

    def stop(self) -> None:
        """Make `run` return soon; may be called from a signal handler."""
        self._stopped = True

    def run(self) -> None:
        """Run until `stop`."""
        run_together(self.simulations, lambda: self._stopped, self._on_event)


def _named(on_event: Callable[[str], None], system_id: int) -> Callable[[str], None]:
    return lambda text: on_event(f"vehicle {system_id}: {text}")
