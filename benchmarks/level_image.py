"""How level levelled images are: the horizon in rendered images of an orbit, before and after.

    python -m benchmarks.level_image --seeds 1..5 [--rolling-shutter-ms 30] [--save FILE.jpg] [--json]

The vehicle flies an orbit of 13 m at 5 m/s, 8 m above the ground, in wind of 2 m/s. The camera (640x480, 80°
across, a lens with distortion) looks ahead and is fixed to the body. The images are levelled by the
autopilot's attitude, received 50 times a second, as the perception worker has it, and by the true one, which
shows what the levelling itself adds. Errors: the slope of a line
through the horizon, its offset from where a level camera with that axis has it, and its bend: the greatest
distance of the horizon from that line. `--save` writes the image of median slope before and after.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.rendered import rendered_scene
from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.bench.synthetic_detector import SceneObject, ScenePose
from mavlink_sim.camera.lens import Shutter
from mavlink_sim.camera.simulated_camera import SimulatedCamera
from vision.camera_model import CameraModel, CameraMount
from vision.levelling import level_camera, level_image, level_rotations, poses_of_readout
from vision.rotation import matrix_from_quaternion
from vision.tracking import AttitudeHistory

CAMERA = replace(
    CameraModel.from_horizontal_fov(640, 480, math.radians(80.0)), distortion=(-0.1, 0.02, 0.001, -0.001)
)
MOUNT = CameraMount(forward_m=0.1)
ORBIT = "orbit radius=13 speed=5"
PERIOD_S, IMAGES, SETTLED_S = 1.3, 12, 6.0
TICK_S = 0.01
# Between the capture and the levelling the attitude of that moment is received.
LATENCY_S = 0.06

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Horizon:
    """The horizon of an image, degrees. `offset_deg`: below the row where it should be."""

    slope_deg: float
    offset_deg: float
    bend_deg: float


@dataclass(frozen=True, slots=True)
class Pair:
    """An image and its horizon, before and after levelling.

    Attributes:
        level, exact: by the autopilot's attitude, by the true one.
    """

    before: Image
    after: Image
    tilted: Horizon
    level: Horizon
    exact: Horizon


def pairs(seed: int, rolling_shutter_s: float, count: int = IMAGES) -> Iterator[Pair]:
    """The images of one orbit; the same seed gives the same."""
    car = SceneObject("car", (4.2, 1.8, 1.5), lambda _: ScenePose(14.0, 3.0, 0.7))
    scene, _ = rendered_scene([car], CAMERA, MOUNT, seed)
    shutter = Shutter(0.0, rolling_shutter_s) if rolling_shutter_s else None
    camera = SimulatedCamera(replace(scene, camera=replace(scene.camera, shutter=shutter)))
    settings = plain_settings({"guidance.max_horizontal_speed_mps": "6"})
    flight = LockstepFlight.airborne(seed=seed, height_m=8.0, wind_mps=2.0, settings=settings)
    attitudes, truths = AttitudeHistory(), AttitudeHistory()

    def fly(seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            flight.run(TICK_S)
            truths.add(flight.now_ns, flight.vehicle.truth.quaternion)
            if flight.state.attitude is not None:
                attitudes.add(flight.state.attitude_ns, flight.state.attitude)

    def levelled(history: AttitudeHistory, image: Image, stamp_ns: int) -> Image:
        def pose_at(at_ns: int) -> tuple[CameraMount, NDArray[np.float64]] | None:
            attitude = history.at(at_ns)
            return None if attitude is None else (MOUNT, attitude)

        poses = poses_of_readout(pose_at, stamp_ns, rolling_shutter_s)
        assert poses is not None
        return level_image(image, CAMERA, level_rotations(poses))

    flight.command(ORBIT)
    fly(SETTLED_S)
    for _ in range(count):
        fly(PERIOD_S)
        for _ in range(2):  # the motion during the readout is that between two captures
            fly(TICK_S)
            truth, stamp_ns = flight.vehicle.truth, flight.now_ns
            attitude = matrix_from_quaternion(truth.quaternion)
            captured = camera.capture(truth.position_ned_m, attitude, stamp_ns, flight.seconds)
        assert captured is not None
        fly(LATENCY_S)
        before = captured.frame.image
        after, exact = (levelled(history, before, stamp_ns) for history in (attitudes, truths))
        north, east, down = (attitude @ MOUNT.body_from_optical)[:, 2]
        elevation_rad = math.atan2(-down, math.hypot(north, east))
        yield Pair(before, after, *(horizon_of(image, elevation_rad) for image in (before, after, exact)))


def horizon_of(image: Image, elevation_rad: float) -> Horizon:
    """Find the horizon: in each column the first pixel from above that is greener than blue.

    Args:
        elevation_rad: of the true optical axis.
    """
    colours = cv2.blur(image, (5, 5)).astype(np.int16)
    seen = image.any(axis=2)
    ground = (colours[:, :, 1] > colours[:, :, 0]) & seen
    edge, top, columns = ground.argmax(axis=0), seen.argmax(axis=0), np.arange(image.shape[1])
    # Not where the ground begins with the image.
    shown = ground.any(axis=0) & (edge > top + 5)
    x, y = columns[shown].astype(np.float64), edge[shown].astype(np.float64)
    if len(x) < 100:
        raise ValueError(f"the horizon is in {len(x)} columns of the image, expected at least 100")
    for _ in range(3):  # without what stands in front of it
        slope, start = np.polyfit(x, y, 1)
        off = y - (slope * x + start)
        near = np.abs(off) <= max(3.0, 2.5 * float(off.std()))
        x, y = x[near], y[near]
    lens = level_camera(CAMERA)
    wanted = lens.cy + lens.fy * math.tan(elevation_rad)
    smooth = np.convolve(y - (slope * x + start), np.full(15, 1 / 15), "valid")
    px_deg = math.degrees(1.0 / lens.fy)
    return Horizon(
        math.degrees(math.atan(slope)),
        (slope * lens.cx + start - wanted) * px_deg,
        float(np.abs(smooth).max()) * px_deg,
    )


def write_image(path: Path, pair: Pair) -> None:
    """The image before and after, beside each other. Raises OSError if it cannot be written."""
    if not cv2.imwrite(str(path), np.hstack([pair.before, pair.after]), [cv2.IMWRITE_JPEG_QUALITY, 85]):
        raise OSError(f"cannot write {path}: check free disk space and write permission")


def main() -> None:
    """Print the errors of all images, and save one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--seeds", default="1..3", help="FIRST..LAST")
    parser.add_argument("--rolling-shutter-ms", type=float, default=0.0)
    parser.add_argument("--save", type=Path, help="File of the image of median slope, before and after.")
    parser.add_argument("--json", action="store_true", help="Print one line for each image.")
    arguments = parser.parse_args()
    first, _, last = arguments.seeds.partition("..")
    taken: list[Pair] = []
    for seed in range(int(first), int(last or first) + 1):
        for pair in pairs(seed, arguments.rolling_shutter_ms / 1e3):
            taken.append(pair)
            if arguments.json:
                by_attitude = {"before": pair.tilted, "after": pair.level, "exact": pair.exact}
                print(json.dumps({"seed": seed} | {name: asdict(each) for name, each in by_attitude.items()}))
    for key in ("slope_deg", "offset_deg", "bend_deg"):
        print(f"{key}, {len(taken)} images:")
        for name, horizons in (
            ("before", [pair.tilted for pair in taken]),
            ("levelled by the autopilot's attitude", [pair.level for pair in taken]),
            ("levelled by the true attitude", [pair.exact for pair in taken]),
        ):
            errors = [abs(getattr(horizon, key)) for horizon in horizons]
            p50, p95 = np.percentile(errors, [50, 95])
            print(f"  {name}: p50 {p50:.2f}, p95 {p95:.2f}, worst {max(errors):.2f}")
    if arguments.save is not None:
        by_slope = sorted(taken, key=lambda pair: abs(pair.tilted.slope_deg))
        write_image(arguments.save, by_slope[len(by_slope) // 2])


if __name__ == "__main__":
    main()
