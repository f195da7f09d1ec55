"""The guidance loop steps at its rate, and at once on a result of the steering camera."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from typing import Any

import pytest

from companion.bus.topics import Topic
from companion.guidance.interface import GuidanceInput, GuidanceOutput
from companion.service import Service
from companion.settings.reading import load_settings
from vision.detections import Detections
from vision.pipeline import PerceptionResult

pytestmark = pytest.mark.realtime

SLOWEST_HZ = "5"


def result(sequence: int) -> PerceptionResult:
    now_ns = time.monotonic_ns()
    nothing = Detections.empty(("car",))
    return PerceptionResult(sequence, now_ns, now_ns, 640, 480, nothing, {"total": 1.0}, dropped=0)


def steps_of(service: Service) -> list[int]:
    """Record the times of guidance's steps, and replace them by steps without a setpoint."""
    times: list[int] = []

    def noted(now_ns: int, inputs: GuidanceInput) -> GuidanceOutput:
        times.append(now_ns)
        return GuidanceOutput(None)

    service.guidance.step = noted  # type: ignore[method-assign]
    return times


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(60.0):
        while not condition():
            await asyncio.sleep(0)


async def test_detection_triggers_a_step_at_once() -> None:
    settings = load_settings(os.devnull, {"guidance.rate_hz": SLOWEST_HZ}, {})
    service = Service(settings)
    sent_now: list[int] = []
    steps = steps_of(service)
    service.streamer.send_now = sent_now.append  # type: ignore[assignment, method-assign]
    steering = asyncio.create_task(service._loop.run())
    try:
        await until(lambda: len(steps) == 1)
        for sequence in range(3):
            service._on_result(service.cameras[0], result(sequence))
            await until(lambda: len(steps) == sequence + 2)  # noqa: B023 - awaited here
        assert steps[1:4] == sent_now
        await until(lambda: len(steps) == 5)
        assert len(sent_now) == 3
        assert steps[4] - steps[3] >= 0.19e9
    finally:
        steering.cancel()
        await asyncio.gather(steering, return_exceptions=True)


async def test_setpoint_is_sent_before_publication() -> None:
    service = Service(load_settings(os.devnull, {"guidance.rate_hz": SLOWEST_HZ}, {}))
    order: list[str] = []
    service.streamer.send_now = lambda _: order.append("setpoint")  # type: ignore[assignment, method-assign]
    service.bus.publish = lambda topic, *_: order.append(topic.name)  # type: ignore[method-assign]
    steering = asyncio.create_task(service._loop.run())
    try:
        await asyncio.sleep(0)
        for sequence in range(3):
            service._on_result(service.cameras[0], result(sequence))
            await until(lambda: len(order) >= 3)
            assert order == ["setpoint", "detections", "labels", "transforms"]
            order.clear()
        status = service.cameras[0].supervisor.status
        assert status.timing_p50_ms.keys() == {"publish"}  # the last stage, measured by the service
    finally:
        steering.cancel()
        await asyncio.gather(steering, return_exceptions=True)


async def test_localization_and_publication_fail_independently(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    service = Service(load_settings(os.devnull, {}, {}))
    camera = service.cameras[0]
    published: list[str] = []

    def publish(topic: Topic, value: Any, view: str | None = None) -> None:
        if (value() if callable(value) else value) is not None:
            published.append(topic.name)

    service.bus.publish = publish  # type: ignore[method-assign]
    with monkeypatch.context() as broken:
        broken.setattr(type(camera), "localize", lambda *_: [][0])
        camera._on_report(result(1))
        assert camera.localization_error.startswith("IndexError")
        await until(lambda: published == ["detections", "labels"])
    with monkeypatch.context() as broken:
        broken.setattr("companion.service.publisher.labels_message", lambda *_: dict[str, str]()["nothing"])
        camera._on_report(result(2))
        assert "attitude" in camera.localization_error
        await until(lambda: camera.localization_error == "KeyError: 'nothing'")
    assert [record.exc_info[0] for record in caplog.records if record.exc_info] == [IndexError, KeyError]


async def test_other_cameras_do_not_trigger_a_step() -> None:
    settings = load_settings(
        os.devnull, {"guidance.rate_hz": SLOWEST_HZ, "cameras.down.source.uri": "down.mp4"}, {}
    )
    service = Service(settings)
    sent_now: list[int] = []
    steps = steps_of(service)
    service.streamer.send_now = sent_now.append  # type: ignore[assignment, method-assign]
    steering = asyncio.create_task(service._loop.run())
    try:
        await until(lambda: len(steps) == 1)
        other = next(camera for camera in service.cameras if camera is not service.inputs.steering)
        service._on_result(other, result(1))
        await until(lambda: len(steps) == 2)
        assert sent_now == []
    finally:
        steering.cancel()
        await asyncio.gather(steering, return_exceptions=True)
