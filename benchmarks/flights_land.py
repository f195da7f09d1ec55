"""Landings on a marker's pad: wind with gusts, estimator noise, and a camera with everything a camera does.

A pad of two AprilTags, a small one in its middle and a large one beside it, lies up to 3 m from below where
the vehicle begins, 6 to 9 m high. The wind is up to 3 m/s with its gusts (the built-in airframe has the drag
of PX4's SIH, 1 N for each m/s on 1 kg: it leans by 17° against 3 m/s). Corners are off by 0.3 pixels (one
sigma), frames come 80 ms late, one in twelve is missed, and so is half a second now and then; the camera sits
a third of a degree (one sigma) from where the settings have it. Rendered flights see drawn images, searched
by OpenCV, instead.
The limits are the default ones, but for `max_acceleration_mps2` 5.

A flight succeeds when the behaviour says that it landed, and the true place is at most 0.3 m beside the pad's
centre.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.flights import FlightResult
from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.synthetic_camera import SyntheticCamera
from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.land_on_marker import LandOnMarkerBehaviour
from companion.guidance.limits.envelope import Limits
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.lockstep import Truth
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.markers import Marker, MarkerDetector, MarkerKind, marker_from_corners, square
from vision.rotation import matrix_from_quaternion

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(75.0))
MOUNT = CameraMount(forward_m=0.08, down_m=0.05, pitch_rad=-math.pi / 2)
DICTIONARY = "APRILTAG_36h11"
MIDDLE, LARGE = 7, 21
SIZES_M = {MIDDLE: 0.14, LARGE: 0.4}
# Of each one's centre, to the right of and above the middle's.
OFFSETS_M = {MIDDLE: (0.0, 0.0), LARGE: (0.0, 0.34)}
CORNER_SIGMA_PX, MISSED, GAP_EACH_S, GAP_S = 0.3, 1 / 12, 8.0, 0.5
MOUNT_SIGMA_RAD = math.radians(0.33)
SMALLEST_SIDE_PX, EDGE_PX = 14.0, 3.0
FAR_M, HEIGHTS_M, STRONGEST_WIND_MPS = 3.0, (6.0, 9.0), 3.0
ALLOWED_M = 0.3
LIMIT_S = 240.0
MAX_ACCELERATION_MPS2 = 5.0
MARKER_SETTINGS = {
    "detector.enabled": "false",
    "markers.dictionary": DICTIONARY,
    "markers.size_m": f"{SIZES_M[MIDDLE]}",
    "markers.others": f"{LARGE}:{SIZES_M[LARGE]}@{MIDDLE}:{OFFSETS_M[LARGE][0]}:{OFFSETS_M[LARGE][1]}",
}


def run(seed: int, *, rendered: bool = False) -> FlightResult:
    """One landing, flown by us. `rendered`: images are drawn, and searched by OpenCV."""
    return land(seed, rendered=rendered)


def land(
    seed: int,
    *,
    by_autopilot: bool = False,
    pad_speed_mps: float = 0.0,
    rendered: bool = False,
    max_acceleration_mps2: float = MAX_ACCELERATION_MPS2,
) -> FlightResult:
    """One landing.

    Args:
        by_autopilot: PX4's precision landing flies it, guided by LANDING_TARGET.
        pad_speed_mps: of a pad that moves in a line.
        rendered: images are drawn and searched; else corners are put where geometry has them.
        max_acceleration_mps2: of the envelope.
    """
    rng = np.random.default_rng((seed, 149))
    away, direction, course = rng.uniform(0.0, FAR_M), *rng.uniform(-math.pi, math.pi, 2)
    pad = Pad(
        (away * math.cos(direction), away * math.sin(direction)),
        float(rng.uniform(-math.pi, math.pi)),
        (pad_speed_mps * math.cos(course), pad_speed_mps * math.sin(course)),
    )
    wind_mps = float(rng.uniform(0.0, STRONGEST_WIND_MPS))
    truly = CameraMount(
        MOUNT.forward_m,
        MOUNT.right_m,
        MOUNT.down_m,
        *(np.array([MOUNT.roll_rad, MOUNT.pitch_rad, MOUNT.yaw_rad]) + rng.normal(0.0, MOUNT_SIGMA_RAD, 3)),
    )
    finder = DrawnCamera(pad, truly) if rendered else ProjectedCamera(pad, truly, rng)
    camera = SyntheticCamera(
        camera_settings(CAMERA, MOUNT, MARKER_SETTINGS),
        find_markers=finder.look,
        rate_hz=10.0 if rendered else 20.0,
    )
    flight = LockstepFlight.airborne(
        seed=seed,
        height_m=float(rng.uniform(*HEIGHTS_M)),
        wind_mps=wind_mps,
        camera=lambda _: camera,
        limits=Limits(max_acceleration_mps2=max_acceleration_mps2),
    )
    behaviour = LandOnMarkerBehaviour(MIDDLE, by_autopilot=by_autopilot, moving=pad_speed_mps > 0.0)
    touched: list[float] = []

    def note_touch() -> None:
        truth = flight.vehicle.truth
        if truth.on_ground and not touched:
            touched.append(math.dist(truth.position_ned_m[:2], pad.place(flight.seconds)))

    log = flight.fly(behaviour, LIMIT_S, on_tick=note_touch)
    outcome = log.outcome or Outcome(False, f"not landed after {LIMIT_S:g} s: {behaviour.status}")
    took_s = flight.seconds
    error_m = touched[0] if touched else math.nan
    descents = sum(words.startswith("descending") for words in flight.state_words)
    near = error_m <= ALLOWED_M
    return FlightResult(
        seed,
        outcome.success and near,
        {"error_m": error_m, "time_s": took_s, "descents": float(descents), "wind_mps": wind_mps},
        outcome.reason if near or not touched else f"{outcome.reason}; truly {error_m:.2f} m beside the pad",
    )


class Pad:
    """Where the pad's centre is, how it is turned and how it moves over ground."""

    def __init__(
        self, start_m: tuple[float, float], yaw_rad: float, velocity_mps: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self._start_m, self.yaw_rad, self._velocity_mps = start_m, yaw_rad, velocity_mps

    def place(self, seconds: float) -> tuple[float, float]:
        """North and east of its centre."""
        return (
            self._start_m[0] + self._velocity_mps[0] * seconds,
            self._start_m[1] + self._velocity_mps[1] * seconds,
        )

    def centre_of(self, identifier: int, seconds: float) -> tuple[float, float]:
        """North and east of one marker's centre."""
        north, east = self.place(seconds)
        right, up = OFFSETS_M[identifier]
        cosine, sine = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return (north + up * cosine - right * sine, east + up * sine + right * cosine)

    def corners_ned(self, identifier: int, seconds: float) -> NDArray[np.float64]:
        """(4, 3) of one marker: upper left, then clockwise as printed."""
        cosine, sine = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        ned_from_marker = np.array([[-sine, cosine, 0.0], [cosine, sine, 0.0], [0.0, 0.0, -1.0]])
        corners = square(SIZES_M[identifier]) @ ned_from_marker.T
        placed: NDArray[np.float64] = corners + np.array([*self.centre_of(identifier, seconds), 0.0])
        return placed

    def plates(self) -> tuple[WorldObject, ...]:
        """Its printed markers as objects of a world, where they begin."""
        return tuple(
            WorldObject(
                number,
                "plate",
                (*self.centre_of(identifier, 0.0), 0.0),
                self.yaw_rad,
                printed=Print(DICTIONARY, identifier, size_m),
            )
            for number, (identifier, size_m) in enumerate(SIZES_M.items())
        )


class ProjectedCamera:
    """Corners put where geometry has them, with noise; frames get lost."""

    def __init__(self, pad: Pad, mount: CameraMount, rng: np.random.Generator) -> None:
        self._pad, self._mount, self._rng = pad, mount, rng
        self._gap_until_s = 0.0

    def look(self, truth: Truth, seconds: float) -> tuple[Marker, ...] | None:
        """The markers of a frame; None: it is missed."""
        if self._rng.random() < 0.05 / GAP_EACH_S:
            self._gap_until_s = seconds + GAP_S
        if seconds < self._gap_until_s or self._rng.random() < MISSED:
            return ()
        ned_from_body = matrix_from_quaternion(truth.quaternion)
        ned_from_optical = self._mount.ned_from_optical(ned_from_body)
        eye = np.array(truth.position_ned_m) + ned_from_body @ self._mount.position_frd_m
        markers = []
        for identifier, size_m in SIZES_M.items():
            ahead = (self._pad.corners_ned(identifier, seconds) - eye) @ ned_from_optical
            pixels = CAMERA.project(ahead)
            inside = (pixels > EDGE_PX) & (pixels < (CAMERA.width - EDGE_PX, CAMERA.height - EDGE_PX))
            side_px = float(np.linalg.norm(pixels[1] - pixels[0]))
            if not inside.all() or side_px < SMALLEST_SIDE_PX:
                continue
            noisy = pixels + self._rng.normal(0.0, CORNER_SIGMA_PX, (4, 2))
            marker = marker_from_corners(identifier, noisy, size_m, CAMERA)
            if marker is not None:
                markers.append(marker)
        return tuple(markers)


class DrawnCamera:
    """Images of the pad, drawn and searched."""

    def __init__(self, pad: Pad, mount: CameraMount) -> None:
        self._renderer = Renderer(World(pad.plates(), Ground(("concrete",), 3, 512, 0.05)), CAMERA, mount)
        self._detector = MarkerDetector(MarkerKind(DICTIONARY, SIZES_M[MIDDLE], SIZES_M))

    def look(self, truth: Truth, seconds: float) -> tuple[Marker, ...] | None:
        """The markers that OpenCV finds in the image."""
        image = self._renderer.render(truth.position_ned_m, matrix_from_quaternion(truth.quaternion))
        return self._detector.detect(np.ascontiguousarray(image.image), CAMERA)
