"""`mavlink-sim bench`: how fast this machine flies, in lockstep and as a fleet.

Everything is measured in processor time of one core, so that what else the machine does hardly matters.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Annotated

import typer

from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.testing import free_udp_ports
from mavlink_sim.wire.messages import dialect
from mavlink_sim.wire.streams import GCS_RATES_HZ, ONBOARD_RATES_HZ

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

FLEET_STEP_S = 0.004


@dataclass(frozen=True, slots=True)
class LockstepFigures:
    """Simulated seconds per second of one core, flying in OFFBOARD.

    Attributes:
        quiet: physics and autopilot, a link that streams nothing.
        onboard: with a companion's full streams, each message taken as an object.
        onboard_bytes: the same, taken as bytes.
        both_bytes: with a ground station's link too.
    """

    quiet: float
    onboard: float
    onboard_bytes: float
    both_bytes: float


def airborne(links: dict[str, dict[str, float]], seed: int = 1) -> LockstepVehicle:
    """A vehicle that follows setpoints of 20 Hz in OFFBOARD."""
    vehicle = LockstepVehicle(links, seed=seed)
    vehicle.take_off(5.0)
    setpoint = dialect.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 2552, 5, 5, -8, 0, 0, 0, 0, 0, 0, 1, 0
    )
    vehicle.repeat(setpoint, 20.0)
    vehicle.step(0.2)
    vehicle.set_mode("OFFBOARD")
    vehicle.receive()
    return vehicle


def _times_real_time(links: dict[str, dict[str, float]], seconds: float, packed: bool) -> float:
    vehicle = airborne(links)
    best = math.inf
    slices = 5  # the best slice: what was disturbed does not count
    for _ in range(slices):
        started = time.process_time()
        for _ in range(round(seconds / slices / 0.1)):
            vehicle.step(0.1)
            for link in links:
                if packed:
                    vehicle.receive_bytes(link)
                else:
                    vehicle.receive(link)
        best = min(best, time.process_time() - started)
    return seconds / slices / best


def measure_lockstep(seconds: float = 20.0) -> LockstepFigures:
    """Fly for so many simulated seconds in each way."""
    full = {"onboard": ONBOARD_RATES_HZ}
    return LockstepFigures(
        _times_real_time({"onboard": {}}, seconds, packed=False),
        _times_real_time(full, seconds, packed=False),
        _times_real_time(full, seconds, packed=True),
        _times_real_time({**full, "gcs": GCS_RATES_HZ}, seconds, packed=True),
    )


def measure_fleet(vehicles: int = 20, seconds: float = 3.0) -> float:
    """Processor seconds of one core per simulated second of a flying fleet on UDP at full stream rates."""
    from mavlink_sim.fleet import Fleet, instance_options
    from mavlink_sim.simulation import SimulationOptions

    onboard, gcs = free_udp_ports(2)
    options = SimulationOptions(
        onboard_port=min(onboard, 65535 - vehicles), gcs_port=gcs, onboard_bind=0, gcs_bind=0
    )
    with Fleet(instance_options(options, vehicles, 5.0), on_event=lambda text: None) as fleet:
        for simulation in fleet:
            autopilot = simulation.vehicle.autopilot
            simulation.vehicle.step(4.0)
            autopilot.arm()
            autopilot.takeoff(5.0)
            simulation.vehicle.step(8.0)
            for link in simulation.vehicle.links:
                simulation.vehicle.outgoing(link)
        best = math.inf
        for _ in range(round(seconds)):
            started = time.process_time()
            for _ in range(round(1.0 / FLEET_STEP_S)):
                for simulation in fleet:
                    simulation.vehicle.step(FLEET_STEP_S)
                    simulation.flush()
            best = min(best, time.process_time() - started)
        return best


@app.command()
def bench(
    vehicles: Annotated[int, typer.Option(min=1, max=250, help="Size of the fleet.")] = 20,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=600.0, help="Simulated seconds of each flight.")
    ] = 20.0,
) -> None:
    """Print how many times faster than real time one core flies a vehicle, and what a fleet costs."""
    figures = measure_lockstep(seconds)
    print(f"lockstep, physics and autopilot:       {figures.quiet:6.0f} times real time")
    print(f"lockstep, onboard link, messages:      {figures.onboard:6.0f} times real time")
    print(f"lockstep, onboard link, bytes:         {figures.onboard_bytes:6.0f} times real time")
    print(f"lockstep, both links, bytes:           {figures.both_bytes:6.0f} times real time")
    share = measure_fleet(vehicles)
    print(
        f"fleet of {vehicles} on UDP, all streams: {100 * share:.0f} % of one core in real time, "
        f"{100 * share / vehicles:.1f} % a vehicle"
    )


if __name__ == "__main__":
    app()
