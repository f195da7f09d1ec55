"""The bearing of an object from a banking vehicle: orbits at 5 m/s, with three sources of attitude.

The vehicle circles at a radius of 12.5 m in wind of up to 5 m/s, leaning by 12° and more. The reported
bearing of the object in the middle is compared with the truth at the moment of capture in three ways: by the
attitude at that moment, as the service does it; by the newest attitude when the result comes 80 ms later; and
by the heading alone, as if the vehicle never leaned. A flight succeeds when the first is within 1.5° in 95
of 100 images. What is judged is the way from a box to a bearing, with boxes made of the truth or by the
real detector.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.flights import FlightResult
from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import Camera, LockstepFlight, Moment
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import Faults, SceneObject, ScenePose, SyntheticDetector
from companion.guidance.behaviours.orbit import Orbit, OrbitBehaviour
from companion.guidance.objects.from_detections import StateHistory
from companion.vehicle.state import VehicleState
from mavlink_sim.lockstep import LockstepVehicle
from vision.camera_model import CameraModel, CameraMount
from vision.pipeline import PerceptionResult
from vision.rotation import matrix_from_quaternion

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-20.0))
RADIUS_M, SPEED_MPS, HEIGHT_M = 12.5, 5.0, 5.0
SETTLED_S, LIMIT_S, LATENCY_S = 6.0, 36.0, 0.08
WITHIN_DEG = 1.5
EXACT = Faults(jitter=0.0, missed=0.0, false_per_frame=0.0, range_sigma=0.0)


class _AttitudeAtCapture:
    """A camera that notes the true attitude at every capture. See `lockstep_flight.Camera`."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.perceived, self.rate_hz, self.latency_s = camera.perceived, camera.rate_hz, camera.latency_s
        self.ned_from_body: dict[int, NDArray[np.float64]] = {}

    def on_state(self, state: VehicleState, history: StateHistory) -> None:
        self._camera.on_state(state, history)

    def capture(self, flight: LockstepFlight) -> Callable[[], PerceptionResult | None]:
        self.ned_from_body[flight.now_ns] = matrix_from_quaternion(flight.vehicle.truth.quaternion)
        return self._camera.capture(flight)


def run(seed: int, *, rendered: bool = False) -> FlightResult:
    """One flight of somewhat more than one lap.

    Args:
        rendered: the camera is drawn and looked at by the real detector and tracker.
    """
    rng = np.random.default_rng((seed, 83))
    yaw_rad = float(rng.uniform(-math.pi, math.pi))
    pose = ScenePose(RADIUS_M * math.cos(yaw_rad), RADIUS_M * math.sin(yaw_rad))
    things = [SceneObject("person", (0.5, 0.6, 1.7), lambda _: pose)]
    settings = camera_settings(CAMERA, MOUNT, {"detector.image_size": "320", "detector.threads": "1"})

    def camera_of(vehicle: LockstepVehicle) -> Camera:
        if rendered:
            scene, _ = rendered_scene(things, CAMERA, MOUNT, seed)
            return RenderedCamera(settings, scene, vehicle, rate_hz=20.0, latency_s=LATENCY_S, depth=False)
        drawn = SyntheticDetector(things, CAMERA, MOUNT, seed=seed, faults=EXACT)
        return SyntheticCamera(settings, detect=drawn, rate_hz=20.0, latency_s=LATENCY_S, tracker=None)

    cameras: list[_AttitudeAtCapture] = []

    def watched(vehicle: LockstepVehicle) -> Camera:
        cameras.append(_AttitudeAtCapture(camera_of(vehicle)))
        return cameras[0]

    flight = LockstepFlight.airborne(
        seed=seed,
        height_m=HEIGHT_M,
        wind_mps=float(rng.uniform(0.0, 5.0)),
        camera=watched,
    )
    flight.turn_to(yaw_rad)
    errors_deg: dict[str, list[float]] = {"at_capture": [], "newest": [], "heading_alone": []}
    leaning_deg: list[float] = []
    judged: set[int] = set()

    def judge(moment: Moment) -> None:
        for target in moment.context.targets:
            if moment.seconds < SETTLED_S or target.captured_ns in judged:
                continue
            judged.add(target.captured_ns)
            left, top, right, bottom = target.box_xyxy
            ray = (
                MOUNT.body_from_optical @ CAMERA.rays(np.array([[(left + right) / 2, (top + bottom) / 2]]))[0]
            )
            truth = cameras[0].ned_from_body[target.captured_ns]
            true_rad = _bearing_rad(truth @ ray)
            newest = moment.context.state.attitude
            assert newest is not None
            reported = {
                "at_capture": target.bearing_rad,
                "newest": _bearing_rad(matrix_from_quaternion(newest) @ ray),
                "heading_alone": _bearing_rad(
                    _levelled(flight.inputs.history.at(target.captured_ns).ned_from_body) @ ray
                ),
            }
            for way, bearing_rad in reported.items():
                off = math.remainder(bearing_rad - true_rad, math.tau)
                errors_deg[way].append(abs(math.degrees(off)))
            leaning_deg.append(math.degrees(math.acos(min(1.0, float(truth[2, 2])))))

    orbit = Orbit(None, RADIUS_M, SPEED_MPS, direction=("counterclockwise", "clockwise")[seed % 2])
    log = flight.fly(OrbitBehaviour(orbit), LIMIT_S, judge)
    if not leaning_deg:
        return FlightResult(seed, False, {}, "the thing in the middle was never seen")
    p95: Callable[[list[float]], float] = lambda values: float(np.percentile(values, 95))  # noqa: E731
    good = p95(errors_deg["at_capture"]) <= WITHIN_DEG and not log.violations
    values = {f"bearing_error_{way}_p95_deg": p95(found) for way, found in errors_deg.items()}
    values["leaning_p50_deg"] = float(np.median(leaning_deg))
    values["images"] = float(len(leaning_deg))
    reason = f"left the envelope: {log.violations}" if log.violations else "" if good else "bearings are off"
    return FlightResult(seed, good, values, reason)


def _bearing_rad(ray_ned: NDArray[np.float64]) -> float:
    return math.atan2(float(ray_ned[1]), float(ray_ned[0]))


def _levelled(ned_from_body: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation of its heading alone."""
    yaw_rad = math.atan2(float(ned_from_body[1, 0]), float(ned_from_body[0, 0]))
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
