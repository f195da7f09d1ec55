"""Publishes the service's data: camera results, vehicle, pose, setpoints."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from typing import Any

from companion.bus import topics
from companion.bus.messages import (
    detections_message,
    labels_message,
    setpoint_message,
    tracks_message,
    vehicle_message,
)
from companion.bus.session import Bus
from companion.guidance.core import Guidance
from companion.guidance.limits.obstacles import obstacles_message
from companion.perception.cameras import WorkerCamera
from companion.perception.messages import Preview
from companion.service.inputs import InputAssembler
from companion.vehicle.driver import Driver
from companion.vehicle.streamer import Streamer
from vision.pipeline import PerceptionResult

logger = logging.getLogger(__package__)


class Publisher:
    """Publishes every topic except `status` and `events`, which the service publishes itself."""

    def __init__(self, vehicle: str, bus: Bus, driver: Driver, inputs: InputAssembler) -> None:
        self._vehicle, self._bus, self._driver, self._inputs = vehicle, bus, driver, inputs

    def publish_result(
        self, camera: WorkerCamera, result: PerceptionResult, markers: dict[str, Any] | None
    ) -> None:
        """Publish a camera's result. Never raises."""
        try:
            self._publish_result(camera, result, markers)
        except Exception as error:
            # Guidance has used the result and continues; the failure is logged and in `status`.
            logger.exception("a result could not be published")
            camera.localization_error = f"{type(error).__name__}: {error}"

    def _publish_result(
        self, camera: WorkerCamera, result: PerceptionResult, markers: dict[str, Any] | None
    ) -> None:
        bus, name, now_ns = self._bus, self._vehicle, time.monotonic_ns()
        message = detections_message(result, name, now_ns, camera.name, self._driver.state.clock)
        bus.publish(topics.DETECTIONS, message, camera.name)
        bus.publish(topics.LABELS, labels_message(result), camera.name)
        if result.track_events:
            bus.publish(topics.TRACKS, tracks_message(result, name, now_ns, camera.name), camera.name)
        if markers is not None:
            bus.publish(topics.MARKERS, {**markers, "published_ns": now_ns}, camera.name)
        if camera is self._inputs.steering and result.obstacles is not None:
            bus.publish(topics.OBSTACLES, obstacles_message(result.obstacles, name))
        camera.supervisor.published(result)

    def publish_preview(self, camera: WorkerCamera, preview: Preview) -> None:
        """Publish a preview image with its stamps."""
        stamps = {"camera": camera.name, "sequence": preview.sequence, "captured_ns": preview.captured_ns}
        self._bus.publish_image(topics.IMAGE, preview.jpeg, stamps, camera.name)

    async def publish_vehicle(
        self, guidance: Guidance, streamer: Streamer, cameras: Sequence[WorkerCamera]
    ) -> None:
        """Publish vehicle, pose and setpoints at the rate of `vehicle`, until cancelled."""
        period_s = 1 / (topics.VEHICLE.rate_hz or 10.0)
        while True:
            now_ns, state = time.monotonic_ns(), self._driver.state
            self._bus.publish(topics.VEHICLE, vehicle_message(state, now_ns))
            pose = self._inputs.poses.message(state, guidance.active, now_ns)
            if pose is not None:
                self._bus.publish(topics.POSE, pose)
            for camera in cameras:
                camera.supervisor.watch(self._bus.watched(topics.IMAGE, camera.name))
            if guidance.in_command:
                self._bus.publish(
                    topics.SETPOINT,
                    {
                        "stamp_ns": now_ns,
                        "asked": setpoint_message(guidance.asked),
                        "sent": setpoint_message(streamer.last_sent),
                        "sent_ns": streamer.last_sent_ns,
                        "stream": streamer.state.value,
                        "limited_by": list(guidance.limited_by),
                    },
                )
            await asyncio.sleep(period_s)
