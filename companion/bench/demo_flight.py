"""The demonstration in lockstep, over many seeds: the same mission, core, camera, network and tracker.

`companion demo` flies it in real time, with processes and sockets; here simulated time waits for the camera
and the network, so that a result does not depend on how busy the computer is. Every figure is the
simulator's truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from rich.table import Table

from companion.bench.lockstep_flight import Camera, LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.simulated_driver import RATES_HZ, SimulatedDriver
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.guidance.missions.sequence import SequenceBehaviour
from companion.settings import Settings
from companion.simulation.campaign import map_seeds
from companion.simulation.session import (
    DEMO_NOISE,
    FIND,
    MISSION,
    RANGE_TOLERANCE_M,
    REACH,
    SIMULATOR_PARAMETERS,
    STAND,
    STOP_DISTANCE_M,
    TARGET_CLASS,
    session_settings,
    with_lens,
)
from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.scene_file import scene_or_demo
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.world.mesh import surface_range_to
from mavlink_sim.world.shapes import CLASS_NAMES, shape_of, variant_of
from mavlink_sim.world.world import World, WorldObject, range_to
from vision.attitude import wrap_angle

LIMIT_S = 240.0
# As the demonstration draws and looks at them, on two cores.
CAMERA_RATE_HZ, LATENCY_S = 10.0, 0.12


@dataclass(frozen=True, slots=True)
class DemoFlight:
    """One demonstration. Ranges are true, horizontal, to the car's nearest surface, metres.

    Attributes:
        confirmed: class of the object that `seek` ended at, by truth; None: it found none.
        arrival_range_m: when the approach said that it had arrived. hold_range_m: after the hold.
        footprint_range_m: after the hold, to the rectangle around the car, which is somewhat nearer.
        time_s: simulated, from the command to its answer.
        failure: why it failed; None: it did not.
    """

    seed: int
    success: bool
    confirmed: str | None
    arrival_range_m: float | None
    hold_range_m: float | None
    footprint_range_m: float | None
    time_s: float
    failure: str | None


def fly_demo(seed: int, *, synthetic: bool = False) -> DemoFlight:
    """One demonstration; the same seed gives the same flight.

    Args:
        synthetic: detections are made of the truth instead of drawn and looked for.
    """
    scene = scene_or_demo(None, seed)
    # The precision `auto` is measured, and may be another one on another machine.
    chosen = Settings.model_validate({"detector": {"precision": "float32"}})
    settings = with_lens(session_settings(14540, "lockstep", chosen=chosen), scene.camera)
    vehicle = LockstepVehicle(
        {"onboard": RATES_HZ}, seed=seed, noise=DEMO_NOISE, parameters=dict(SIMULATOR_PARAMETERS)
    )
    camera: Camera
    if synthetic:
        camera = _synthetic_camera(settings, scene, seed)
    else:
        camera = RenderedCamera(settings, scene, vehicle, rate_hz=CAMERA_RATE_HZ, latency_s=LATENCY_S)
    flight = LockstepFlight(SimulatedDriver(vehicle), settings, [camera])
    flight.run_until(lambda: flight.state.ready_to_arm, 30.0)
    flight.begun_ns = flight.now_ns
    identifier = flight.command(f"mission {MISSION}")
    # It begins when home is known.
    flight.run_until(lambda: flight.guidance.busy or flight.outcome(identifier) is not None, 5.0)
    behaviour = flight.guidance.behaviour
    confirmed: str | None = None
    seen: str | None = None
    ranges_m: dict[str, tuple[float, float]] = {}
    while flight.seconds < LIMIT_S and flight.outcome(identifier) is None:
        flight.tick()
        seen = _faced(scene.world, flight) or seen
        records = behaviour.records if isinstance(behaviour, SequenceBehaviour) else []
        if records and records[-1].title not in ranges_m and records[-1].success:
            ranges_m[records[-1].title] = _range_to_target(scene.world, vehicle)
            if records[-1].title == FIND:
                confirmed = seen
    outcome = flight.outcome(identifier)
    arrival_m, _ = ranges_m.get(REACH, (None, None))
    hold_m, footprint_m = ranges_m.get(STAND, (None, None))
    failure = None
    if outcome is None:
        failure = f"not finished in {LIMIT_S:g} s: {flight.guidance.status}"
    elif not outcome.success:
        words = behaviour.with_step(outcome) if isinstance(behaviour, SequenceBehaviour) else outcome
        failure = words.reason
    elif confirmed != TARGET_CLASS:
        failure = f"confirmed a {confirmed}, not a {TARGET_CLASS}"
    elif hold_m is None or abs(hold_m - STOP_DISTANCE_M) > RANGE_TOLERANCE_M:
        failure = f"stood {_metres(hold_m)} from the {TARGET_CLASS}, not {STOP_DISTANCE_M:g} m"
    elif vehicle.truth.armed or not vehicle.truth.landed:
        failure = "the vehicle is not on the ground and disarmed"
    return DemoFlight(
        seed,
        failure is None,
        confirmed,
        None if arrival_m is None else round(arrival_m, 2),
        None if hold_m is None else round(hold_m, 2),
        None if footprint_m is None else round(footprint_m, 2),
        round(flight.seconds, 1),
        failure,
    )


def fly_demos(
    seeds: Sequence[int], *, processes: int = 1, ray: str | None = None, synthetic: bool = False
) -> Iterator[DemoFlight]:
    """One for each seed, in the seeds' order; see `map_seeds`."""
    return map_seeds(partial(fly_demo, synthetic=synthetic), seeds, processes=processes, ray=ray)


def demos_summary(flights: Sequence[DemoFlight]) -> dict[str, Any]:
    """Plain values, ready for JSON."""
    errors_m = [abs(f.hold_range_m - STOP_DISTANCE_M) for f in flights if f.hold_range_m is not None]
    footprint_errors_m = [
        abs(f.footprint_range_m - STOP_DISTANCE_M) for f in flights if f.footprint_range_m is not None
    ]
    return {
        "flights": len(flights),
        "successes": sum(flight.success for flight in flights),
        "worst_range_error_m": round(max(errors_m), 2) if errors_m else None,
        "worst_footprint_error_m": round(max(footprint_errors_m), 2) if footprint_errors_m else None,
        "seeds": [asdict(flight) for flight in flights],
    }


def demos_table(flights: Sequence[DemoFlight]) -> Table:
    """The flights as a table."""
    succeeded = sum(flight.success for flight in flights)
    table = Table(title=f"demonstration: {succeeded} of {len(flights)} succeeded")
    for heading in (
        "seed",
        "success",
        "confirmed",
        "range at arrival",
        "after the hold",
        "footprint",
        "time",
    ):
        table.add_column(heading, justify="right")
    table.add_column("why it failed", justify="left")
    for flight in flights:
        table.add_row(
            f"{flight.seed}",
            "yes" if flight.success else "no",
            flight.confirmed or "-",
            _metres(flight.arrival_range_m),
            _metres(flight.hold_range_m),
            _metres(flight.footprint_range_m),
            f"{flight.time_s:.1f} s",
            flight.failure or "",
        )
    return table


def _range_to_target(world: World, vehicle: LockstepVehicle) -> tuple[float, float]:
    """To the nearest car, by truth: its surface, and its footprint."""
    place = vehicle.truth.position_ned_m
    cars = [item for item in world.objects if item.class_name == TARGET_CLASS]
    nearest = min(cars, key=lambda item: range_to(item, place))
    return surface_range_to(nearest, place), range_to(nearest, place)


def _faced(world: World, flight: LockstepFlight) -> str | None:
    """Class of the object that stands where guidance believes the one it faces to be; None: none is seen."""
    context = flight.guidance.context
    if context is None or not context.targets:
        return None
    yaw_rad = context.state.yaw_rad or 0.0
    seen = [t for t in context.targets if t.class_name == TARGET_CLASS and t.position_ned_m is not None]
    if not seen:
        return None
    faced = min(seen, key=lambda target: abs(wrap_angle(target.bearing_rad - yaw_rad)))
    assert faced.position_ned_m is not None
    place = faced.position_ned_m
    return min(world.objects, key=lambda item: range_to(item, place)).class_name


def _synthetic_camera(settings: Settings, scene: Scene, seed: int) -> SyntheticCamera:
    """The scene's objects as upright boxes, those that no class stands for only hide others."""
    model, mount = scene.camera.model, scene.camera.mount
    objects = [_as_box(item) for item in scene.objects_at(0.0)]
    detector = SyntheticDetector(objects, model, mount, seed=seed, with_depth=True)
    return SyntheticCamera(
        settings,
        detect=detector,
        size=(model.width, model.height),
        rate_hz=CAMERA_RATE_HZ,
        latency_s=LATENCY_S,
        tracker=settings.tracker.following(settings.detector.confidence),
    )


def _as_box(item: WorldObject) -> SceneObject:
    rear, front, left, right = item.footprint_m
    shape = shape_of(item.class_name, variant_of(item.class_name, item.appearance))
    pose = ScenePose(item.position_ned_m[0], item.position_ned_m[1], item.yaw_rad)
    height_m = float(-shape.low[2] * item.scale)
    class_name = item.class_name if item.class_name in CLASS_NAMES else ""
    return SceneObject(class_name, (front - rear, right - left, height_m), lambda _: pose)


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} m"
