"""A flight in lockstep with a camera on a gimbal, which looks where the built-in vehicle's gimbal does."""

from __future__ import annotations

import math

from companion.bench.drawn_detector import DrawnDetector, Faults, Pose, Thing
from companion.bench.lockstep_flight import LockstepFlight, Sight
from companion.guidance.search_pattern import Footprint
from vision.attitude import Quaternion
from vision.camera_model import CameraModel, CameraMount

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
ON_GIMBAL = CameraMount(forward_m=0.1, on_gimbal=True)
FOOTPRINT = Footprint(math.radians(80.0), 0.0)
HEIGHT_M = 10.0
PERSON_M = (0.5, 0.6, 1.7)


def person(bearing_deg: float, distance_m: float = 4.0) -> Thing:
    """Somebody who stands."""
    bearing = math.radians(bearing_deg)
    pose = Pose(distance_m * math.cos(bearing), distance_m * math.sin(bearing))
    return Thing("person", PERSON_M, lambda _: pose)


def gimbal_flight(
    thing: Thing, *, seed: int = 5, mount: CameraMount = ON_GIMBAL, **options: object
) -> LockstepFlight:
    """In the air, with a detector that sees the thing where the gimbal looks at it."""
    flights: list[LockstepFlight] = []

    def looks() -> Quaternion:
        # The first frame comes after the take-off, when the flight is there.
        return flights[0].vehicle.vehicle.gimbal.quaternion

    # A box that shakes is the detector's fault, and is measured elsewhere.
    detector = DrawnDetector(
        [thing], CAMERA, mount, seed=seed, faults=Faults(0.0, 0.05, 0.0, 0.0), gimbal=looks
    )
    sight = Sight(CAMERA, mount, detector)
    flights.append(LockstepFlight(seed=seed, height_m=HEIGHT_M, sight=sight, gimbal=True, **options))
    return flights[0]
