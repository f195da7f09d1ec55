"""The rendered camera in its own process: poses arrive by a pipe, frames go to its outputs.

The newest pose is used. The process ends when its pipe closes, so it never outlives the one that started it.
"""

from __future__ import annotations

import contextlib
import logging
import math
import multiprocessing
import os
import signal
import struct
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path

import cv2
import numpy as np

from mavlink_sim.camera.aircraft_poses import SharedPoses
from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.camera.renderer import DEFAULT_CAMERA, DEFAULT_MOUNT
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.camera.simulated_camera import Captured, SimulatedCamera, truth_line
from mavlink_sim.camera.video_outputs import check_output, open_output
from mavlink_sim.world.aircraft import Aircraft
from mavlink_sim.world.truth_file import TruthFile
from mavlink_sim.world.world import World
from vision.camera_model import CameraCalibration, CameraModel, CameraMount
from vision.rotation import matrix_from_quaternion
from vision.shared_frame import remove_leavings

logger = logging.getLogger(__name__)

POSE = struct.Struct("=3d4dqd3dqB")
"""Position NED in metres, quaternion (w, x, y, z) of `ned_from_body`, CLOCK_MONOTONIC nanoseconds, the
scene's time in seconds, the camera's roll, pitch, yaw on the body (NaN: as mounted), and the
number of the other aircraft's poses (-1: there are none); what is frozen (`CameraFreeze`)."""
OUTPUT_FAILED = 2
"""Exit code of the process: one of its outputs could not be opened."""
EARLY_SHARE = 0.3
"""A pose that arrives early by up to this share of a period is drawn at once, to allow for jitter."""


def run_camera(
    scene: Scene,
    rate_hz: float,
    outputs: Sequence[str],
    truth: Path | None,
    poses: Connection,
    ready: Event,
    shared_poses: SharedPoses | None = None,
    written: Event | None = None,
    on_gimbal: bool = False,
) -> None:
    """Draw a frame for the newest pose, at most `rate_hz` times per second, until `poses` closes.

    The frames' `captured_ns` is the stamp of their pose. The outputs open when the ground has been prepared
    and the first frame can be drawn without delay. `shared_poses` has the poses of the other aircraft; None
    if there are none. `written` is set when the first frame is at its outputs. `on_gimbal`: the poses include
    the camera's angles, and readers get the mount of a camera on a gimbal. An output that cannot be opened is
    one line on standard error and exit code 2.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the starting process stops this one, by the pipe
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # or by this: rendering does not read the pipe
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    cv2.setNumThreads(1)
    model, mount = scene.camera.model, scene.camera.mount
    SimulatedCamera(scene).capture((0.0, 0.0, -2.0), np.eye(3), 0)
    camera = SimulatedCamera(scene)
    signal.signal(
        signal.SIGTERM, signal.SIG_IGN
    )  # from here on outputs have to be closed: end only by the pipe
    with ExitStack() as resources:
        level = replace(mount, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, on_gimbal=True)
        calibration = CameraCalibration(model, level if on_gimbal else mount)
        sinks, lines = [], None
        try:
            for address in outputs:
                sink = open_output(address, model.width, model.height, rate_hz, calibration=calibration)
                sinks.append(sink)
                resources.callback(sink.close)
            if truth is not None:
                lines = TruthFile(truth)
                resources.callback(lines.close)
        except (OSError, ValueError, ModuleNotFoundError) as error:
            print(f"camera: {error}", file=sys.stderr, flush=True)
            sys.exit(OUTPUT_FAILED)
        ready.set()
        period_s = 1.0 / rate_hz
        due_s = time.monotonic()
        on_the_way: deque[Captured] = deque()

        def deliver() -> float | None:
            """Output the frames that are due; returns seconds until the next one, None if none is pending."""
            while on_the_way and on_the_way[0].arrives_ns <= time.monotonic_ns():
                captured = on_the_way.popleft()
                for sink in sinks:
                    sink.write(captured.frame)
                if written is not None:
                    written.set()
                if lines is not None:
                    why = lines.write(truth_line(captured))
                    if why is not None:
                        print(f"camera: {why}", file=sys.stderr, flush=True)
            return max(on_the_way[0].arrives_ns - time.monotonic_ns(), 0) / 1e9 if on_the_way else None

        while True:
            try:
                latest = _newest(poses, deliver())
            except EOFError:
                return
            if latest is None:
                continue
            due_now_s = due_s - EARLY_SHARE * period_s
            if time.monotonic() < due_now_s:
                while (wait_s := due_now_s - time.monotonic()) > 0.0:
                    arrival_s = deliver()
                    time.sleep(wait_s if arrival_s is None else min(wait_s, arrival_s))
                if poses.poll(0.0):
                    continue
            *values, stamp_ns, time_s, roll, pitch, yaw, number, frozen = POSE.unpack(latest)
            others: tuple[Aircraft, ...] | None = ()
            if shared_poses is not None and number >= 0:
                others = shared_poses.read(number)
            if others is None:
                continue  # so old that they were overwritten: a newer pose follows
            due_s = max(due_s + period_s, time.monotonic())
            turned = mount
            if not math.isnan(roll):
                turned = replace(mount, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
            attitude = matrix_from_quaternion((values[3], values[4], values[5], values[6]))
            freeze = CameraFreeze(frozen)
            frame = camera.capture(
                values[:3], attitude, int(stamp_ns), time_s, turned, others=others, freeze=freeze
            )
            if frame is not None:
                on_the_way.append(frame)


def _newest(poses: Connection, timeout_s: float | None) -> bytes | None:
    """The newest pose, waiting for one; None if none came in time. Raises EOFError when the pipe closed."""
    newest: bytes | None = None
    try:
        if not poses.poll(timeout_s):
            return None
        while newest is None or poses.poll(0.0):
            newest = poses.recv_bytes(POSE.size)
    except ConnectionResetError as error:
        raise EOFError from error
    return newest


class CameraProcess:
    """Starts, feeds and stops the camera's process.

    Args:
        world: the world; a scene has its own camera, and `camera` and `mount` are ignored then.
        rate_hz: frames per second at most.
        shared_name: of the shared memory for colour and depth; None for none.
        outputs: further addresses of `video_outputs`.
        truth: a file for the objects in each frame, one JSON object per line.
        most_others: greatest number of other aircraft.
        on_gimbal: every pose includes the camera's angles (`camera_rpy_rad`).

    Raises:
        ValueError: an invalid rate or address, or no output at all.
    """

    def __init__(
        self,
        world: World | Scene,
        camera: CameraModel = DEFAULT_CAMERA,
        mount: CameraMount = DEFAULT_MOUNT,
        rate_hz: float = 30.0,
        shared_name: str | None = "mavlink-sim-camera",
        outputs: Sequence[str] = (),
        truth: Path | None = None,
        most_others: int = 0,
        on_gimbal: bool = False,
    ) -> None:
        if not rate_hz > 0.0:
            raise ValueError(f"the camera's rate must be positive, got {rate_hz} Hz")
        scene = world if isinstance(world, Scene) else Scene(world, camera=CameraSettings(camera, mount))
        addresses = ([f"shm://{shared_name}"] if shared_name is not None else []) + list(outputs)
        if not addresses and truth is None:
            raise ValueError("the camera has no output; give a shared memory's name or an address")
        for address in addresses:
            check_output(address)
        context = multiprocessing.get_context("spawn")
        self._receiving, self._sending = context.Pipe(duplex=False)
        # A camera that hangs must not block the vehicle: with a full pipe the pose is dropped.
        os.set_blocking(self._sending.fileno(), False)
        self._ready, self._written = context.Event(), context.Event()
        self._shared_poses = SharedPoses(context, most_others) if most_others > 0 else None
        self._process = context.Process(
            target=run_camera,
            args=(
                scene,
                rate_hz,
                addresses,
                truth,
                self._receiving,
                self._ready,
                self._shared_poses,
                self._written,
                on_gimbal,
            ),
            name="mavlink-sim camera",
            daemon=True,
        )
        self.name = ", ".join([shared_name] if shared_name is not None else []) or ", ".join(addresses)
        self.shared_name = shared_name
        self.dropped_poses = 0

    def start(self) -> None:
        """Start the process; does not wait. The first frame follows when the ground is prepared (seconds)."""
        # Ctrl-C reaches every process of a terminal; it is blocked until the new one ignores it
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._receiving.close()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.is_alive()

    @property
    def ready(self) -> bool:
        """Whether its outputs are open and the first frame can be drawn without delay."""
        return self._ready.is_set()

    @property
    def written(self) -> bool:
        """Whether the first frame is at its outputs."""
        return self._written.is_set()

    @property
    def exit_code(self) -> int | None:
        """Of the process; None while it runs. `OUTPUT_FAILED`: an output could not be opened."""
        return self._process.exitcode

    @property
    def pid(self) -> int | None:
        """The process number, None before `start`."""
        return self._process.pid

    def send_pose(
        self,
        position_ned_m: Sequence[float],
        quaternion: tuple[float, float, float, float],
        stamp_ns: int,
        time_s: float | None = None,
        camera_rpy_rad: tuple[float, float, float] | None = None,
        others: Sequence[Aircraft] = (),
        freeze: CameraFreeze = CameraFreeze.NOTHING,
    ) -> None:
        """Send the vehicle's pose, and those of the other aircraft; never blocks.

        Args:
            quaternion: (w, x, y, z) of `ned_from_body`.
            stamp_ns: CLOCK_MONOTONIC of the pose.
            time_s: the scene's time, which moves its objects; by default the stamp in seconds.
            camera_rpy_rad: a gimbal's roll, pitch, yaw from the body; None leaves the camera as mounted.
            others: the other aircraft at the time of the stamp.
            freeze: what repeats the frame before.

        Raises:
            ValueError: there are more others than `most_others`.
        """
        number = -1
        if self._shared_poses is not None:
            number = self._shared_poses.write(others)
        elif others:
            raise ValueError(f"{len(others)} other aircraft: this camera was made for none")
        pose = POSE.pack(
            *(float(value) for value in position_ned_m),
            *quaternion,
            stamp_ns,
            stamp_ns / 1e9 if time_s is None else time_s,
            *(camera_rpy_rad or (math.nan,) * 3),
            number,
            freeze,
        )
        try:
            self._sending.send_bytes(pose)
            if self._shared_poses is not None:
                self._shared_poses.keep()
        except BlockingIOError:
            self.dropped_poses += 1
            if self.dropped_poses == 1:
                logger.warning("the camera process reads no poses; dropping them")
        except OSError:
            self.dropped_poses += 1
            if self.dropped_poses == 1:
                logger.error("the camera process is gone (exit code %s)", self._process.exitcode)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Close the pipe and wait for the process to end, also while it starts; kill it if it does not."""
        for connection in (self._sending, self._receiving):
            with contextlib.suppress(OSError):
                connection.close()
        if self._process.pid is None:
            return
        if not self.ready:
            self._process.terminate()
        self._process.join(timeout_s)
        if self._process.is_alive():
            logger.warning("the camera process did not end in %.1f s; killing it", timeout_s)
            self._process.kill()
            self._process.join()
        if self.shared_name is not None:
            remove_leavings(self.shared_name)  # of a killed process: they use memory
