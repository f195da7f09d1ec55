"""Commands around a pillar, with rendered depth, the worker's own map and paths, in lockstep."""

from __future__ import annotations

import math

import pytest

from benchmarks.flights_forest import CAMERA, SENSOR, Map, forest, run
from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import FlightLog, LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.world.world import Ground, World, WorldObject, range_to
from tests.companion.guidance.guidance_harness import assert_succeeded
from vision.camera_model import CameraModel, CameraMount

LARGE = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1)
MARGIN_M, ALLOWED_M = 1.0, 0.4
PILLAR = WorldObject(0, "box", (7.0, 0.2, 0.0), size_m=(1.0, 1.0, 6.0))
GROUND = Ground(("meadow", "grass"), 5, 1024, 0.08)
PLAIN = Ground(("concrete",), 5, 256, 0.08)  # painted sooner


class Flight:
    """In the air before the pillar, looking north; `nearest_m` and `aside_m` are measured as it flies."""

    def __init__(self, *objects: WorldObject, detector: bool, seed: int = 5) -> None:
        flags = {
            "detector.enabled": str(detector).lower(),
            "detector.image_size": "320",
            "detector.threads": "1",
            "guidance.obstacles": "required",
            "guidance.obstacle_margin_m": str(MARGIN_M),
            "guidance.avoid": "true",
        }
        camera, sensor = (LARGE, DepthSensor()) if detector else (CAMERA, SENSOR)
        settings = camera_settings(camera, MOUNT, flags)
        sensed = CameraSettings(model=camera, mount=MOUNT, depth=sensor, seed=seed)
        self.scene = Scene(World((PILLAR, *objects), GROUND if detector else PLAIN), {}, sensed, "pillar")
        self.flight = LockstepFlight.airborne(
            seed=seed,
            height_m=2.5,
            wind_mps=1.5,
            camera=lambda vehicle: RenderedCamera(settings, self.scene, vehicle, rate_hz=5.0),
            scene=self.scene,
        )
        self.flight.turn_to(0.0)
        self.nearest_m, self.aside_m = math.inf, 0.0

    def fly(self, command: str, limit_s: float = 60.0) -> FlightLog:
        return self.flight.fly(command, limit_s, on_tick=self._measure)

    def _measure(self) -> None:
        position = self.flight.vehicle.truth.position_ned_m
        self.nearest_m = min(self.nearest_m, range_to(PILLAR, position))
        self.aside_m = max(self.aside_m, abs(position[1]))

    def assert_passed(self, log: FlightLog) -> None:
        """It arrived by a way around the pillar."""
        assert_succeeded(log.outcome)
        assert self.flight.vehicle.truth.collisions == 0
        assert self.nearest_m > MARGIN_M - ALLOWED_M
        assert self.aside_m > 1.0


@pytest.mark.parametrize(
    ("command", "end"),
    [
        pytest.param("goto north=14 east=0 speed=2", (14.0, 0.0), marks=pytest.mark.slow),
        ("follow-path points=3,0;14,0;14,4 speed=2", (14.0, 4.0)),
        pytest.param("patrol points=0,0;11,0 classes=car laps=1 speed=2", (0.0, 0.0), marks=pytest.mark.slow),
    ],
    ids=["goto", "follow-path", "patrol"],
)
def test_command_flies_around_a_pillar(command: str, end: tuple[float, float]) -> None:
    flown = Flight(detector=False)
    flown.assert_passed(flown.fly(command))
    assert math.dist(flown.flight.vehicle.truth.position_ned_m[:2], end) < 1.0


@pytest.mark.slow
def test_approach_flies_around_a_pillar() -> None:
    # Seen beside the pillar; the straight way would pass the pillar at 0.4 m.
    car = WorldObject(1, "car", (17.0, -1.8, 0.0), 0.0, appearance=3)
    flown = Flight(car, detector=True)
    log = flown.fly("approach car distance=5 speed=2")
    flown.assert_passed(log)
    assert range_to(car, flown.flight.vehicle.truth.position_ned_m) == pytest.approx(5.0, abs=0.7)


@pytest.mark.slow
def test_forest_is_crossed_and_drawn() -> None:
    drawing = Map(3)
    result = run(3, drawing.add)
    assert result.success, result.reason
    assert result.values["nearest_m"] > MARGIN_M - ALLOWED_M
    assert result.values["flown_m"] > 40.0
    image = drawing.image()
    assert len({tuple(colour) for colour in image.reshape(-1, 3)[::97].tolist()}) >= 3
    assert len(forest(3)) == 45
