"""Publishes the service's data: camera results, cameras, vehicle, pose, setpoints."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from urllib.parse import quote

from companion.bus import topics
from companion.bus.bodies.frames import TransformsBody
from companion.bus.messages import (
    Localization,
    ModelIdentity,
    camera_info_message,
    cloud_attachment,
    depth_image_attachment,
    depth_message,
    detections_message,
    image_attachment,
    labels_message,
    markers_message,
    obstacles_message,
    tracks_message,
    transforms_message,
)
from companion.bus.session import Bus
from companion.bus.vehicle_messages import (
    geodetic_origin,
    pose_message,
    setpoints_message,
    vehicle_message,
)
from companion.guidance.core import Guidance
from companion.guidance.objects.from_detections import HistoryError
from companion.guidance.objects.from_markers import LocalizedMarkers
from companion.perception.cameras import PerceptionCamera, WorkerCamera
from companion.perception.messages import AnyPreview, CloudPreview, DepthPreview
from companion.perception.supervisor import PerceptionState
from companion.service.inputs import InputAssembler
from companion.service.queries import Queries
from companion.vehicle.driver import Driver
from companion.vehicle.streamer import Streamer
from vision.pipeline import PerceptionResult

_LOOK_S = 0.1

logger = logging.getLogger(__package__)


def localization_of(camera: PerceptionCamera) -> Localization:
    """Return what guidance gets of a camera's result, to publish it."""
    objects = camera.objects.objects
    if camera.repeats:  # the targets are those of an earlier result
        return Localization(error="no new image", objects=objects)
    return Localization(camera.targets, camera.localization_error, objects=objects)


class Publisher:
    """Publishes every topic except `status` and `events`, which the service publishes itself."""

    def __init__(
        self, vehicle: str, bus: Bus, driver: Driver, inputs: InputAssembler, queries: Queries
    ) -> None:
        self._vehicle, self._bus, self._driver = vehicle, bus, driver
        self._inputs, self._queries = inputs, queries
        self._preview_failed = False

    def publish_result(
        self,
        camera: WorkerCamera,
        result: PerceptionResult,
        markers: LocalizedMarkers | None,
        localization: Localization,
    ) -> None:
        """Publish a camera's result. Never raises.

        Args:
            localization: of the result's detections, if `camera` is the steering one.
        """
        try:
            self._publish_result(camera, result, markers, localization)
        except Exception as error:
            # Guidance has used the result and continues; the failure is logged and in `status`.
            logger.exception("a result could not be published")
            camera.localization_error = f"{type(error).__name__}: {error}"

    def _publish_result(
        self,
        camera: WorkerCamera,
        result: PerceptionResult,
        markers: LocalizedMarkers | None,
        localization: Localization,
    ) -> None:
        bus, vehicle, name, now_ns = self._bus, self._vehicle, camera.name, time.monotonic_ns()
        state, steering = self._driver.state, camera is self._inputs.steering
        of_frame = result, vehicle, now_ns, name

        def located() -> Localization:
            return replace(localization, origin=geodetic_origin(state, now_ns))

        bus.publish(
            topics.DETECTIONS,
            lambda: detections_message(
                result,
                vehicle,
                now_ns,
                name,
                state.clock,
                model=_model(camera),
                localization=located() if steering else None,
            ),
            name,
        )
        bus.publish(topics.LABELS, lambda: labels_message(result), name)
        if result.track_events:
            bus.publish(
                topics.TRACKS,
                lambda: tracks_message(*of_frame, localization=located() if steering else None),
                name,
            )
        if markers is not None:
            bus.publish(topics.MARKERS, lambda: markers_message(*of_frame, markers, located().origin), name)
        if result.depth is not None:
            bus.publish(topics.DEPTH, lambda: depth_message(result, vehicle, now_ns, name), name)
        if (obstacles := result.obstacles) is not None and steering:
            bus.publish(topics.OBSTACLES, lambda: obstacles_message(obstacles, vehicle))
        bus.publish(topics.TRANSFORMS, lambda: self._transforms(camera, result), name)
        camera.supervisor.published(result)

    def _transforms(self, camera: WorkerCamera, result: PerceptionResult) -> TransformsBody | None:
        mount, history = camera.settings.camera.mount(), self._inputs.history
        try:
            return transforms_message(
                result.sequence, result.captured_ns, mount, history, self._vehicle, camera.name
            )
        except HistoryError:
            return None  # `localization_error` has the reason

    def publish_cameras(self, cameras: Sequence[WorkerCamera]) -> None:
        """Publish lens and mount of every camera that has given a frame."""
        now_ns = time.monotonic_ns()
        for camera in cameras:
            if (newest := camera.newest) is None:
                continue
            section = camera.settings.camera
            message = camera_info_message(
                section.model(newest.width, newest.height),
                section.mount(),
                calibrated=section.lens is not None,
                vehicle=self._vehicle,
                view=camera.name,
                now_ns=now_ns,
            )
            self._bus.publish(topics.CAMERA_INFO, message, camera.name)

    def publish_preview(self, camera: WorkerCamera, preview: AnyPreview) -> None:
        """Publish a point cloud, a depth image, or an image, which also answers the queries for one.

        Never raises: perception goes on. A fault is logged once, until a preview is published again.
        """
        try:
            self._publish_preview(camera, preview)
        except Exception:
            if not self._preview_failed:
                logger.exception("a preview could not be published (logged once, until one is)")
            self._preview_failed = True
        else:
            self._preview_failed = False

    def _publish_preview(self, camera: WorkerCamera, preview: AnyPreview) -> None:
        if isinstance(preview, CloudPreview):
            about = cloud_attachment(
                preview.sequence, preview.captured_ns, self._vehicle, camera.name, preview.points
            )
            self._bus.publish_large(topics.CLOUD, preview.data, about, camera.name)
            return
        if isinstance(preview, DepthPreview):
            size = depth_image_attachment(
                preview.sequence, preview.captured_ns, camera.name, preview.width, preview.height
            )
            self._bus.publish_large(topics.DEPTH_IMAGE, preview.data, size, camera.name)
            return
        self._queries.on_image(camera, preview.jpeg)
        attachment = image_attachment(
            preview.sequence, preview.captured_ns, camera.name, annotated=camera.settings.preview.annotate
        )
        self._bus.publish_large(topics.IMAGE, preview.jpeg, attachment, camera.name)

    async def publish_vehicle(
        self, guidance: Guidance, streamer: Streamer, cameras: Sequence[WorkerCamera]
    ) -> None:
        """Publish vehicle, pose and setpoints at the rate of `vehicle`, until cancelled."""
        period_s = 1 / (topics.VEHICLE.rate_hz or 10.0)
        while True:
            self._publish_vehicle(guidance, streamer, time.monotonic_ns())
            for camera in cameras:
                image, depth, clouds = (
                    self._bus.watched(topic, camera.name)
                    for topic in (topics.IMAGE, topics.DEPTH_IMAGE, topics.CLOUD)
                )
                image = image or self._queries.image_wanted(camera)
                camera.supervisor.watch(image, depth=depth, clouds=clouds)
            self._bus.set_alive(_alive(cameras))
            await asyncio.sleep(period_s)

    async def wait_status_due(self) -> None:
        """Wait until the next `status` is due: its period, or less if the vehicle arms or changes its mode.

        When the service is gone, its clients say what the vehicle does by its last status.
        """
        state, due_s = self._driver.state, time.monotonic() + 1 / (topics.STATUS.rate_hz or 1.0)
        before = state.armed, state.mode
        while True:
            await asyncio.sleep(_LOOK_S)
            state = self._driver.state
            if time.monotonic() >= due_s or (state.armed, state.mode) != before:
                return

    def _publish_vehicle(self, guidance: Guidance, streamer: Streamer, now_ns: int) -> None:
        bus, state, poses = self._bus, self._driver.state, self._inputs.poses
        bus.publish(topics.VEHICLE, lambda: vehicle_message(state, now_ns))
        note = None if (active := guidance.runner.active) is None else active.note
        # By the clock that counts a suspend: until guidance's next step the state may be from before it.
        pose = poses.pose(state, note, self._driver.watch.now_ns(), in_command=guidance.in_command)
        if pose is not None:
            bus.publish(topics.POSE, lambda: pose_message(pose))
        if guidance.in_command:
            bus.publish(topics.SETPOINT, lambda: setpoints_message(guidance, streamer, now_ns))


def _alive(cameras: Sequence[WorkerCamera]) -> set[str]:
    """Return the liveliness tokens of the cameras and models that run."""
    alive = set()
    for camera in cameras:
        if camera.supervisor.state is PerceptionState.RUNNING:
            part = "camera" if camera.name is None else f"cameras/{camera.name}"
            alive.add(part)
            if (model := _model(camera)) is not None:
                # A path has characters that a key must not have.
                alive.add(f"{part}/model/{quote(model.name, safe='')}")
    return alive


def _model(camera: WorkerCamera) -> ModelIdentity | None:
    ready = camera.supervisor.ready
    return None if ready is None or ready.model is None else ModelIdentity(ready.model, ready.model_sha256)
