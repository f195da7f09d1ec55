"""The camera of a scene: poses in, frames with their truth out. No process, no clock."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.depth_camera import measured_depth
from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.camera.lens import CameraMotion
from mavlink_sim.camera.renderer import Rendered, Renderer
from mavlink_sim.camera.scene import Scene
from mavlink_sim.world.aircraft import Aircraft, aircraft_objects, identifier_offset
from vision.camera_model import CameraMount
from vision.frame import Frame

LONGEST_GAP_S = 0.5
"""The motion between two poses farther apart than this is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """One frame and its truth.

    Attributes:
        frame: as delivered by the camera.
        rendered: the visible objects with their boxes; true depth.
        time_s: the scene's time.
        arrives_ns: arrival, on the clock of its stamp: the stamp plus the camera's latency.
    """

    frame: Frame
    rendered: Rendered
    time_s: float
    arrives_ns: int


class SimulatedCamera:
    """The camera of a scene; the same calls give the same frames.

    `capture` returns its frames in-process; `process` runs one in its own process.

    >>> import numpy as np
    >>> from mavlink_sim import Scene, SimulatedCamera
    >>> from mavlink_sim.camera.scene import CameraSettings
    >>> from mavlink_sim.world.world import World, WorldObject
    >>> from vision import CameraModel
    >>> lens = CameraSettings(CameraModel.from_horizontal_fov(160, 120, 1.4))
    >>> scene = Scene(World((WorldObject(0, "car", (12.0, 0.0, 0.0)),)), camera=lens)
    >>> captured = SimulatedCamera(scene).capture((0.0, 0.0, -2.0), np.eye(3), stamp_ns=0)
    >>> captured.frame.image.shape
    (120, 160, 3)
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.settings = scene, scene.camera
        settings = scene.camera
        self._noise = np.random.default_rng((settings.seed, 1))
        self._losses = np.random.default_rng((settings.seed, 2))
        self._renderer = Renderer(
            scene.world,
            settings.model,
            settings.mount,
            settings.effects,
            rng=self._noise,
            shutter=settings.shutter,
            draw_within_m=settings.draw_within_m,
        )
        self._identifier_offset = identifier_offset(scene.world)
        self._others_shown = False
        self._sequence = -1
        self._shown: tuple[NDArray[np.uint8], NDArray[np.float32]] | None = None
        self._last: tuple[int, NDArray[np.float64], NDArray[np.float64]] | None = None

    def capture(
        self,
        position_ned_m: Sequence[float],
        ned_from_body: NDArray[np.float64],
        stamp_ns: int,
        time_s: float | None = None,
        mount: CameraMount | None = None,
        motion: CameraMotion | None = None,
        others: Sequence[Aircraft] = (),
        freeze: CameraFreeze = CameraFreeze.NOTHING,
    ) -> Captured | None:
        """The frame at a pose, or None if it is lost.

        Args:
            position_ned_m: (3,) of the vehicle.
            ned_from_body: (3, 3) its attitude.
            stamp_ns: becomes the frame's `captured_ns`.
            time_s: the scene's time, which positions moving objects; by default the stamp in seconds.
            mount: the current one of a camera on a gimbal.
            motion: of the camera; by default that between the last call's pose and this one's.
            others: the other aircraft at that time; the own one is not visible.
            freeze: what repeats the frame before.
        """
        settings = self.settings
        time_s = stamp_ns / 1e9 if time_s is None else time_s
        self._sequence += 1
        used = mount or settings.mount
        ned_from_optical = used.ned_from_optical(ned_from_body)
        eye = np.asarray(position_ned_m, np.float64) + ned_from_body @ used.position_frd_m
        last, self._last = self._last, (stamp_ns, eye, ned_from_optical)
        if settings.loss > 0.0 and self._losses.random() < settings.loss:
            return None
        if motion is None:
            motion = CameraMotion() if last is None else _motion_between(last, self._last)
        if self.scene.paths or others or self._others_shown:
            self._others_shown = bool(others)
            aircraft = aircraft_objects(others, self._identifier_offset)
            self._renderer.place(self.scene.objects_at(time_s) + aircraft)
        rendered = self._renderer.render(position_ned_m, ned_from_body, used, motion)
        depth = rendered.depth_m
        if settings.depth is not None:
            depth = measured_depth(depth, settings.model.fx, settings.depth, self._noise)
        image = np.ascontiguousarray(rendered.image)
        if self._shown is not None:
            image = self._shown[0] if CameraFreeze.IMAGE in freeze else image
            depth = self._shown[1] if CameraFreeze.DEPTH in freeze else depth
        self._shown = image, depth
        if CameraFreeze.CLOCK in freeze:
            image = image.copy()
            cv2.putText(image, f"{stamp_ns / 1e9:.3f}", (4, 12), cv2.FONT_HERSHEY_PLAIN, 0.8, (255,) * 3)
        frame = Frame(image, stamp_ns, self._sequence, depth)
        return Captured(frame, rendered, time_s, stamp_ns + round(settings.latency_s * 1e9))


def _motion_between(
    before: tuple[int, NDArray[np.float64], NDArray[np.float64]],
    now: tuple[int, NDArray[np.float64], NDArray[np.float64]],
) -> CameraMotion:
    """The mean motion between two poses (stamp ns, eye NED, ned_from_optical), in the later one's frame."""
    elapsed_s = (now[0] - before[0]) / 1e9
    if not 0.0 < elapsed_s <= LONGEST_GAP_S:
        return CameraMotion()
    velocity = now[2].T @ (now[1] - before[1]) / elapsed_s
    turn = before[2].T @ now[2]
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2.0
    sine, cosine = float(np.linalg.norm(axis)), (float(np.trace(turn)) - 1.0) / 2.0
    angle = float(np.arctan2(sine, cosine))
    rate = axis * (angle / sine / elapsed_s) if sine > 1e-9 else np.zeros(3)
    return CameraMotion(
        (float(velocity[0]), float(velocity[1]), float(velocity[2])),
        (float(rate[0]), float(rate[1]), float(rate[2])),
    )


def frame_truth(captured: Captured) -> dict[str, Any]:
    """The truth of a frame, as plain values for JSON; one entry for each object with at least one pixel.

    `xyxy` are the box's edges in pixels, `range_m` is horizontal from the camera to the footprint,
    `distance_m` is from the camera to the object's position. `stamp_ns` and `sequence` are the frame's.

    >>> import numpy as np
    >>> from mavlink_sim import Scene, SimulatedCamera, frame_truth
    >>> from mavlink_sim.camera.scene import CameraSettings
    >>> from mavlink_sim.world.world import World, WorldObject
    >>> from vision import CameraModel
    >>> lens = CameraSettings(CameraModel.from_horizontal_fov(160, 120, 1.4))
    >>> scene = Scene(World((WorldObject(0, "car", (12.0, 0.0, 0.0)),)), camera=lens)
    >>> captured = SimulatedCamera(scene).capture((0.0, 0.0, -2.0), np.eye(3), stamp_ns=0)
    >>> [(seen["class_name"], seen["position_ned_m"]) for seen in frame_truth(captured)["objects"]]
    [('car', [12.0, 0.0, 0.0])]
    """
    eye = captured.rendered.eye_ned_m
    objects = []
    for seen in captured.rendered.objects:
        item = seen.world_object
        entry: dict[str, Any] = {
            "identifier": item.identifier,
            "class_name": item.class_name,
            "xyxy": list(seen.xyxy),
            "visible_fraction": round(seen.visible_fraction, 4),
            "pixel_count": seen.pixel_count,
            "range_m": round(seen.range_m, 3),
            "distance_m": round(float(np.linalg.norm(eye - item.position_ned_m)), 3),
            "position_ned_m": [round(value, 3) for value in item.position_ned_m],
            "yaw_rad": round(item.yaw_rad, 4),
        }
        if item.system_id is not None:
            entry["system_id"] = item.system_id
            entry["roll_rad"] = round(item.roll_rad, 4)
            entry["pitch_rad"] = round(item.pitch_rad, 4)
        if item.printed is not None:
            entry["marker"] = {
                "dictionary": item.printed.dictionary,
                "id": item.printed.identifier,
                "size_m": item.printed.size_m,
            }
        objects.append(entry)
    return {
        "stamp_ns": captured.frame.captured_ns,
        "sequence": captured.frame.sequence,
        "time_s": round(captured.time_s, 6),
        "camera_ned_m": [round(float(value), 4) for value in eye],
        "objects": objects,
    }


def truth_line(captured: Captured) -> str:
    """`frame_truth` as one line of JSON."""
    return json.dumps(frame_truth(captured))
