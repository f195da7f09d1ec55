"""The rendered camera in a process of its own: poses go in by a pipe, frames come out through shared memory.

The newest pose wins. The process ends when its pipe closes, so it never outlives the one that started it.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import struct
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection

import cv2
import numpy as np

from mavlink_sim.image_effects import MILD_EFFECTS
from mavlink_sim.renderer import DEFAULT_CAMERA, DEFAULT_MOUNT, Renderer
from mavlink_sim.world import World
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.rotation import matrix_from_quaternion
from vision.shared_frame import SharedFrameWriter

logger = logging.getLogger(__name__)

POSE = struct.Struct("=3d4dq")
"""Position NED in metres, quaternion (w, x, y, z) of `ned_from_body`, CLOCK_MONOTONIC nanoseconds."""
EARLY_SHARE = 0.3
"""A pose that comes this share of a period early is drawn at once: the poses' own rhythm jitters."""


def run_camera(
    world: World,
    camera: CameraModel,
    mount: CameraMount,
    rate_hz: float,
    shared_name: str,
    poses: Connection,
) -> None:
    """Draw a frame for the newest pose, at most `rate_hz` times a second, until `poses` closes.

    The frames' `captured_ns` is the stamp of the pose that they were drawn from. The shared memory appears
    when the ground has been painted and the first frame can be drawn without delay.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the starting process stops this one, by the pipe
    cv2.setNumThreads(1)
    renderer = Renderer(world, camera, mount, MILD_EFFECTS)
    renderer.render((0.0, 0.0, -2.0), np.eye(3))
    with SharedFrameWriter(shared_name, camera.width, camera.height, depth=True) as writer:
        period_s = 1.0 / rate_hz
        due_s = time.monotonic()
        sequence = 0
        while True:
            latest = _newest(poses)
            if latest is None:
                return
            wait_s = due_s - EARLY_SHARE * period_s - time.monotonic()
            if wait_s > 0.0:
                time.sleep(wait_s)
                if poses.poll(0.0):
                    continue
            due_s = max(due_s + period_s, time.monotonic())
            *values, stamp_ns = POSE.unpack(latest)
            rendered = renderer.render(values[:3], matrix_from_quaternion((*values[3:7],)))
            writer.write(Frame(rendered.image, int(stamp_ns), sequence, rendered.depth_m))
            sequence += 1


def _newest(poses: Connection) -> bytes | None:
    """The newest pose, waiting for one; None when the pipe has closed."""
    newest: bytes | None = None
    try:
        while newest is None or poses.poll(0.0):
            newest = poses.recv_bytes(POSE.size)
    except (EOFError, ConnectionResetError):
        return None
    return newest


class CameraProcess:
    """Starts, feeds and stops the camera's process."""

    def __init__(
        self,
        world: World,
        camera: CameraModel = DEFAULT_CAMERA,
        mount: CameraMount = DEFAULT_MOUNT,
        rate_hz: float = 30.0,
        shared_name: str = "mavlink-sim-camera",
    ) -> None:
        if not rate_hz > 0.0:
            raise ValueError(f"the camera's rate must be positive, got {rate_hz} Hz")
        context = multiprocessing.get_context("spawn")
        self._receiving, self._sending = context.Pipe(duplex=False)
        # A camera that hangs must not hang the vehicle: a full pipe drops the pose instead.
        os.set_blocking(self._sending.fileno(), False)
        self._process = context.Process(
            target=run_camera,
            args=(world, camera, mount, rate_hz, shared_name, self._receiving),
            name="mavlink-sim camera",
            daemon=True,
        )
        self.shared_name = shared_name
        self.dropped_poses = 0

    def start(self) -> None:
        """Start the process; returns at once. Its first frame comes when the ground is painted (seconds)."""
        self._process.start()
        self._receiving.close()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.is_alive()

    @property
    def pid(self) -> int | None:
        """The process number, None before `start`."""
        return self._process.pid

    def send_pose(
        self,
        position_ned_m: Sequence[float],
        quaternion: tuple[float, float, float, float],
        stamp_ns: int,
    ) -> None:
        """Hand over the vehicle's pose; never blocks.

        Args:
            quaternion: (w, x, y, z) of `ned_from_body`.
            stamp_ns: CLOCK_MONOTONIC when the vehicle was there.
        """
        pose = POSE.pack(*(float(value) for value in position_ned_m), *quaternion, stamp_ns)
        try:
            self._sending.send_bytes(pose)
        except BlockingIOError:
            self.dropped_poses += 1
            if self.dropped_poses == 1:
                logger.warning("the camera process takes no poses; dropping them")
        except OSError:
            self.dropped_poses += 1
            if self.dropped_poses == 1:
                logger.error("the camera process is gone (exit code %s)", self._process.exitcode)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Close the pipe and wait for the process to end; kill it if it does not."""
        for connection in (self._sending, self._receiving):
            with contextlib.suppress(OSError):
                connection.close()
        if self._process.pid is None:
            return
        self._process.join(timeout_s)
        if self._process.is_alive():
            logger.warning("the camera process did not end in %.1f s; killing it", timeout_s)
            self._process.kill()
            self._process.join()
