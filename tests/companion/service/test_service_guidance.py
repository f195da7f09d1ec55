"""The loop that steers turns at its rate, and at once when the steering camera has seen something."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable

import pytest

from companion.guidance.interface import GuidanceInput, GuidanceOutput
from companion.service import Service
from companion.settings.reading import load_settings
from vision.detections import Detections
from vision.pipeline import PerceptionResult

SLOWEST_HZ = "5"


def result(sequence: int) -> PerceptionResult:
    now_ns = time.monotonic_ns()
    nothing = Detections.empty(("car",))
    return PerceptionResult(sequence, now_ns, now_ns, 640, 480, nothing, {"total": 1.0}, dropped=0)


def steps_of(service: Service) -> list[int]:
    """The times of guidance's steps, from now on; nothing is steered."""
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


async def test_a_new_detection_is_flown_by_at_once_and_without_one_the_rate_holds() -> None:
    settings = load_settings(os.devnull, {"guidance.rate_hz": SLOWEST_HZ}, {})
    service = Service(settings)
    hastened: list[int] = []
    turns = steps_of(service)
    service.streamer.send_now = hastened.append  # type: ignore[assignment, method-assign]
    steering = asyncio.create_task(service._loop.run())
    try:
        await until(lambda: len(turns) == 1)
        for sequence in range(3):
            service._on_result(service.views[0], result(sequence))
            await until(lambda: len(turns) == sequence + 2)  # noqa: B023 - awaited here
        assert turns[1:4] == hastened
        await until(lambda: len(turns) == 5)
        assert len(hastened) == 3
        assert turns[4] - turns[3] >= 0.19e9
    finally:
        steering.cancel()
        await asyncio.gather(steering, return_exceptions=True)


async def test_it_is_flown_by_before_it_is_published() -> None:
    service = Service(load_settings(os.devnull, {"guidance.rate_hz": SLOWEST_HZ}, {}))
    order: list[str] = []
    service.streamer.send_now = lambda _: order.append("setpoint")  # type: ignore[assignment, method-assign]
    service.bus.publish = lambda topic, *_: order.append(topic.name)  # type: ignore[method-assign]
    steering = asyncio.create_task(service._loop.run())
    try:
        await asyncio.sleep(0)
        for sequence in range(3):
            service._on_result(service.views[0], result(sequence))
            await until(lambda: len(order) >= 3)
            assert order == ["setpoint", "detections", "labels"]
            order.clear()
        status = service.views[0].supervisor.status
        assert status.timing_p50_ms.keys() == {"publish"}  # the last of the stages, told when it is over
    finally:
        steering.cancel()
        await asyncio.gather(steering, return_exceptions=True)


async def test_a_fault_on_one_side_does_not_silence_the_other(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    service = Service(load_settings(os.devnull, {}, {}))
    view = service.views[0]
    published: list[str] = []
    service.bus.publish = lambda topic, *_: published.append(topic.name)  # type: ignore[method-assign]
    with monkeypatch.context() as broken:
        broken.setattr(type(view), "place", lambda *_: [][0])
        view._on_report(result(1))
        assert view.localization_error == "IndexError: list index out of range"
        await until(lambda: published == ["detections", "labels"])
    with monkeypatch.context() as broken:
        broken.setattr("companion.service.publisher.labels_message", lambda *_: dict[str, str]()["nothing"])
        view._on_report(result(2))
        assert view.localization_error == "no attitude of the vehicle received yet"
        await until(lambda: view.localization_error == "KeyError: 'nothing'")
    assert [record.getMessage() for record in caplog.records if record.exc_info] == [
        "a detection message could not be used",
        "a detection message could not be published",
    ]


async def test_what_another_camera_sees_is_not_waited_for() -> None:
    settings = load_settings(
        os.devnull, {"guidance.rate_hz": SLOWEST_HZ, "cameras.down.source.uri": "down.mp4"}, {}
    )
    service = Service(settings)
    hastened: list[int] = []
    turns = steps_of(service)
    service.streamer.send_now = hastened.append  # type: ignore[assignment, method-assign]
    steering = asyncio.create_task(service._loop.run())
    try:
        await until(lambda: len(turns) == 1)
        other = next(view for view in service.views if view is not service.inputs.steering)
        service._on_result(other, result(1))
        await until(lambda: len(turns) == 2)
        assert hastened == []
    finally:
        steering.cancel()
        await asyncio.gather(steering, return_exceptions=True)
