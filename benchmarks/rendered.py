"""Settings and scenes of flights in lockstep with a calibrated, rendered camera."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.bench.lockstep_flight import plain_settings
from companion.bench.synthetic_detector import SceneObject
from companion.settings import Settings
from companion.settings.calibration import adopt_calibration
from companion.vehicle.state import Vector3
from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.world.world import Ground, Light, Sky, World, WorldObject
from vision.camera_model import CameraCalibration, CameraModel, CameraMount

# Where what is hidden is taken to.
AWAY_M = 2000.0


def camera_settings(
    camera: CameraModel, mount: CameraMount, changes: Mapping[str, str] | None = None
) -> Settings:
    """The default settings for a calibrated camera that is mounted so, with changes.

    The network computes in float32: `auto` measures, and would select another precision on another machine.
    """
    settings = plain_settings({"detector.precision": "float32"} | dict(changes or {}))
    adopted = adopt_calibration(settings.camera, CameraCalibration(camera, mount)).camera
    return settings.model_copy(update={"camera": adopted})


def rendered_scene(
    objects: Sequence[SceneObject],
    camera: CameraModel,
    mount: CameraMount,
    seed: int,
    *,
    depth: bool = False,
    alike: bool = False,
) -> tuple[Scene, tuple[SceneObject, ...]]:
    """The objects on a field, and the same with the sizes of those that are drawn, in their order.

    Args:
        objects: of classes that can be drawn; one that is hidden is taken away meanwhile.
        depth: the camera is a stereo camera with depth; False: its frames have none.
        alike: those of one class have one shape and colour.
    """
    rng = np.random.default_rng((seed, 73))
    drawn, sized = [], []
    appearance = int(rng.integers(2**31))
    for number, item in enumerate(objects):
        if number and not alike:
            appearance = int(rng.integers(2**31))
        thing = WorldObject(number, item.class_name, (0.0, 0.0, 0.0), appearance=appearance)
        rear, front, left, right = thing.footprint_m
        drawn.append(thing)
        sized.append(replace(item, size_m=(front - rear, right - left, item.size_m[2])))
    ground = Ground(("meadow", "grass"), seed, 1024, 0.08)
    world = World(tuple(drawn), ground, Light(float(rng.uniform(-math.pi, math.pi))), Sky(seed=seed))
    motions = {number: _ObjectMotion(item) for number, item in enumerate(objects)}
    sensor = DepthSensor() if depth else None
    settings = CameraSettings(model=camera, mount=mount, depth=sensor, seed=seed)
    return Scene(world, motions, settings, "campaign"), tuple(sized)


@dataclass(frozen=True, slots=True)
class _ObjectMotion:
    item: SceneObject
    speed_mps: float = 0.0  # nothing runs into it
    period_s: float = 0.0

    def pose_at(self, time_s: float) -> tuple[Vector3, float]:
        pose = self.item.pose(time_s)
        away_m = AWAY_M if self.item.hidden(time_s) else 0.0
        return (pose.north_m + away_m, pose.east_m, 0.0), pose.yaw_rad
