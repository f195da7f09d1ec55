"""`mavlink-sim bench`: the speed of lockstep, fleet and camera on this machine.

Everything is measured in CPU time of one core, so that other load has little effect.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import typer

from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.testing import free_udp_ports
from mavlink_sim.wire.streams import GCS_RATES_HZ, ONBOARD_RATES_HZ

if TYPE_CHECKING:
    from vision.camera_model import CameraModel

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

FLEET_STEP_S = 0.004
SLICES = 5  # the best slice is used, to exclude disturbances
LENS = (-0.12, 0.03, 0.0005, -0.0003)  # k1, k2, p1, p2 of a low-cost wide lens


@dataclass(frozen=True, slots=True)
class LockstepFigures:
    """Simulated seconds per CPU second, flying in OFFBOARD.

    Attributes:
        quiet: physics and autopilot, a link without streams.
        onboard: with a companion's full streams, each message read as an object.
        onboard_bytes: the same, read as bytes.
        both_bytes: with a ground station's link too.
    """

    quiet: float
    onboard: float
    onboard_bytes: float
    both_bytes: float


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """Frames per CPU second, 640x480, colour and metric depth, from a vehicle that flies and turns.

    Attributes:
        plain: a pinhole camera over the demo world, which `--camera` shows without a scene.
        distorted: the same through a lens with radial and tangential distortion.
        busy: a pinhole camera over the scene `village`, with more and moving objects.
        crowded: as `plain`, with the 19 other vehicles of a fleet flying in view.
    """

    plain: float
    distorted: float
    busy: float
    crowded: float


def airborne(links: dict[str, dict[str, float]], seed: int = 1) -> LockstepVehicle:
    """A vehicle that follows setpoints of 20 Hz in OFFBOARD."""
    vehicle = LockstepVehicle(links, seed=seed)
    vehicle.take_off(5.0)
    vehicle.set_position(5.0, 5.0, -8.0, yaw_rad=1.0)
    vehicle.receive()
    return vehicle


def _times_real_time(links: dict[str, dict[str, float]], seconds: float, packed: bool) -> float:
    vehicle = airborne(links)
    best = math.inf
    steps = max(round(seconds / SLICES / 0.1), 1)
    for _ in range(SLICES):
        started = time.process_time()
        for _ in range(steps):
            vehicle.step(0.1)
            for link in links:
                if packed:
                    vehicle.receive_bytes(link)
                else:
                    vehicle.receive(link)
        best = min(best, time.process_time() - started)
    return steps * 0.1 / best


def measure_lockstep(seconds: float = 20.0) -> LockstepFigures:
    """Measure lockstep, with this many simulated seconds for each figure."""
    full = {"onboard": ONBOARD_RATES_HZ}
    return LockstepFigures(
        _times_real_time({"onboard": {}}, seconds, packed=False),
        _times_real_time(full, seconds, packed=False),
        _times_real_time(full, seconds, packed=True),
        _times_real_time({**full, "gcs": GCS_RATES_HZ}, seconds, packed=True),
    )


def measure_fleet(vehicles: int = 20, seconds: float = 3.0) -> float:
    """CPU seconds per simulated second of a flying fleet on UDP at full stream rates."""
    from mavlink_sim.realtime.fleet import Fleet, instance_options
    from mavlink_sim.realtime.options import SimulationOptions

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
        for _ in range(max(round(seconds), 1)):
            started = time.process_time()
            for _ in range(round(1.0 / FLEET_STEP_S)):
                for simulation in fleet:
                    simulation.vehicle.step(FLEET_STEP_S)
                    simulation.flush()
            best = min(best, time.process_time() - started)
        return best


def measure_camera(frames: int = 100) -> CameraFigures:
    """Measure the camera, with this many frames for each figure, at least one per slice."""
    import cv2  # only this figure needs OpenCV

    from mavlink_sim.camera.renderer import DEFAULT_CAMERA

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        distorted = replace(DEFAULT_CAMERA, distortion=LENS)
        return CameraFigures(
            _frames_a_second(None, DEFAULT_CAMERA, frames),
            _frames_a_second(None, distorted, frames),
            _frames_a_second("village", DEFAULT_CAMERA, frames),
            _frames_a_second(None, DEFAULT_CAMERA, frames, others=19),
        )
    finally:
        cv2.setNumThreads(threads)


def _frames_a_second(scene: str | None, model: CameraModel, frames: int, others: int = 0) -> float:
    from mavlink_sim.camera.scene import CameraSettings
    from mavlink_sim.camera.scene_file import scene_or_demo
    from mavlink_sim.camera.simulated_camera import SimulatedCamera
    from mavlink_sim.world.aircraft import Aircraft
    from vision.attitude import quaternion_from_euler
    from vision.rotation import matrix_from_quaternion

    camera = SimulatedCamera(replace(scene_or_demo(scene, 0), camera=CameraSettings(model)))

    def draw(number: int) -> None:
        time_s = number / 30.0
        yaw_rad, north_m = 0.2 * time_s, 2.0 * time_s
        attitude = matrix_from_quaternion(quaternion_from_euler(0.05, -0.05, yaw_rad))
        fleet = []
        for index in range(others):  # rows of five in front of it, which turn with it
            ahead_m, right_m = 8.0 + 3.0 * (index // 5), 2.0 * (index % 5 - 2)
            north = north_m + ahead_m * math.cos(yaw_rad) - right_m * math.sin(yaw_rad)
            east = ahead_m * math.sin(yaw_rad) + right_m * math.cos(yaw_rad)
            fleet.append(Aircraft(2 + index, (north, east, -3.0), 0.05, -0.05, yaw_rad))
        camera.capture((north_m, 0.0, -5.0), attitude, round(time_s * 1e9), time_s, others=fleet)

    draw(0)  # the ground is textured
    count = max(frames // SLICES, 1)
    best = math.inf
    for part in range(SLICES):
        started = time.process_time()
        for number in range(part * count, (part + 1) * count):
            draw(number + 1)
        best = min(best, time.process_time() - started)
    return count / best


@app.command()
def bench(
    vehicles: Annotated[int, typer.Option(min=1, max=250, help="Size of the fleet.")] = 20,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=600.0, help="Simulated seconds of each flight.")
    ] = 20.0,
) -> None:
    """Print the speed of one core in lockstep and for camera frames, and the load of a fleet."""
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
    drawn = measure_camera()
    print(f"camera, 640x480, colour and depth:     {drawn.plain:6.0f} frames per second")
    print(f"camera, the same through a lens:       {drawn.distorted:6.0f} frames per second")
    print(f"camera, scene village:                 {drawn.busy:6.0f} frames per second")
    print(f"camera, a fleet of 20 in view:         {drawn.crowded:6.0f} frames per second")


if __name__ == "__main__":
    app()
