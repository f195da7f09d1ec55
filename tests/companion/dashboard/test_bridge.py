"""From zenoh to the page's state, with real sessions; a second session plays the service."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any

import pytest
import zenoh

from companion.bus.session import Bus, zenoh_config
from companion.bus.topics import (
    DETECTIONS,
    EVENTS,
    IMAGE,
    LARGEST_JSON_BYTES,
    STATUS,
    VEHICLE,
    alive_key,
    command_key,
)
from companion.dashboard.fleet import MAX_COMMANDS, Fleet
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port

pytestmark = pytest.mark.realtime

NAME = "vehicle1"
FOUND = {
    "class_id": 1,
    "class_name": "car",
    "confidence": 0.9,
    "xyxy": [64.0, 48.0, 320.0, 240.0],
    "track_id": 7,
    "track_state": "confirmed",
    "object_id": None,
}
BOX = [0.1, 0.1, 0.5, 0.5, "car", 0.9, 7, "confirmed"]


def frame(sequence: int, **more: Any) -> dict[str, Any]:
    return {
        "sequence": sequence,
        "width": 640,
        "height": 480,
        "model": "default",
        "detections": [FOUND],
        "objects": [],
        **more,
    }


class Publisher:
    """The service's end."""

    def __init__(self, endpoint: str, name: str = NAME, connect: str | None = None) -> None:
        section = ZenohSection(listen=(endpoint,), connect=() if connect is None else (connect,))
        self.session = zenoh.open(zenoh_config(section))
        self.token = self.session.liveliness().declare_token(alive_key(name))
        self._image = self.session.declare_publisher(IMAGE.key(name))

    def publish(self, key: str, value: Any) -> None:
        self.session.put(key, value if isinstance(value, str | bytes) else json.dumps(value))

    def image(self, sequence: int, jpeg: bytes = b"jpeg", **more: Any) -> None:
        self._image.put(jpeg, attachment=json.dumps({"sequence": sequence, "captured_ns": 5, **more}))

    @property
    def image_is_watched(self) -> bool:
        return bool(self._image.matching_status.matching)  # type: ignore[attr-defined]


@contextmanager
def publishing(
    endpoint: str | None = None, name: str = NAME, connect: str | None = None
) -> Iterator[tuple[Publisher, str]]:
    endpoint = endpoint or f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    publisher = Publisher(endpoint, name, connect)
    try:
        yield publisher, endpoint
    finally:
        publisher.session.close()  # type: ignore[no-untyped-call]


@asynccontextmanager
async def bridging(endpoint: str) -> AsyncIterator[Fleet]:
    fleet = Fleet(ZenohSection(mode="client", connect=(endpoint,), listen=()), NAME)
    running = asyncio.create_task(fleet.run())
    try:
        yield fleet
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def until(condition: Callable[[], Any], timeout_s: float = 15.0) -> Any:
    deadline_s = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline_s
        await asyncio.sleep(0.02)
    return value


async def test_state_is_the_newest_message_of_each_topic() -> None:
    with publishing() as (service, endpoint):
        async with bridging(endpoint) as fleet:
            bridge = fleet.first
            with fleet.watching(bridge):
                await until(lambda: bridge.alive)
                for height in (1.0, 2.0):
                    service.publish(VEHICLE.key(NAME), {"altitude_m": height})
                service.publish(DETECTIONS.key(NAME, "down"), frame(3))
                service.publish(EVENTS.key(NAME), {"level": "info", "text": "ready"})
                await until(lambda: len(bridge.news(0).topics) == 2 and bridge.news(0).events)
                await until(lambda: json.loads(bridge.news(0).topics["vehicle"])["altitude_m"] == 2.0)
                news = bridge.news(0)
                assert json.loads(news.topics["cameras/down/detections"])["sequence"] == 3
                assert news.events == [{"level": "info", "text": "ready"}]
                assert 0.0 <= news.ages_s["vehicle"] < 5.0
                later = bridge.news(news.number)
                assert (later.topics, later.events, later.number) == ({}, [], news.number)
                assert set(later.ages_s) == set(news.topics)


async def test_kept_events_arrive_once_when_a_page_opens_later() -> None:
    section = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    bus = Bus(section, NAME, on_event=lambda *_: None, on_command=_no_command)
    await bus.start()
    try:
        events = [{"stamp_ns": number, "level": "info", "text": f"event {number}"} for number in range(5)]
        for event in events:
            bus.publish(EVENTS, event)
        bus.publish(STATUS, {"healthy": True})
        async with bridging(section.listen[0]) as fleet:
            bridge = fleet.first
            for _ in range(2):
                with fleet.watching(bridge):
                    await until(lambda: bridge.alive and "status" in bridge.news(0).topics)
                    await until(lambda: len(bridge.news(0).events) >= len(events))
            with fleet.watching(bridge):
                bus.publish(EVENTS, {"stamp_ns": 5, "level": "info", "text": "last"})
                await until(lambda: bridge.news(0).events[-1]["text"] == "last")
            assert bridge.news(0).events[:-1] == events
    finally:
        await bus.close()


async def _no_command(text: str) -> dict[str, Any]:
    return {"success": False, "reason": text}


async def test_useless_messages_are_ignored() -> None:
    with publishing() as (service, endpoint):
        async with bridging(endpoint) as fleet:
            bridge = fleet.first
            with fleet.watching(bridge):
                await until(lambda: bridge.alive)
                for bad in (
                    "{",
                    "[1]",
                    '{"altitude_m": NaN}',
                    b"\xff\xfe",
                    "[" * 100_000,
                    "9" * LARGEST_JSON_BYTES + "9",
                ):
                    service.publish(VEHICLE.key(NAME), bad)
                    service.publish(DETECTIONS.key(NAME), bad)
                service.publish(DETECTIONS.key(NAME), {"detections": []})  # no sequence

                def useful() -> bool:  # one may be dropped after the large ones
                    service.publish(STATUS.key(NAME), {"healthy": True})
                    return "status" in bridge.news(0).topics

                await until(useful)
                assert set(bridge.news(0).topics) == {"status"}


async def test_image_has_the_boxes_of_its_frame() -> None:
    with publishing() as (service, endpoint):
        async with bridging(endpoint) as fleet:
            bridge = fleet.first
            with fleet.watching(bridge):
                await until(lambda: bridge.alive)
                asked = asyncio.create_task(bridge.image("", -1, 20.0))
                await until(lambda: service.image_is_watched)
                service.publish(DETECTIONS.key(NAME), frame(4, detections=[]))
                service.publish(DETECTIONS.key(NAME), frame(5))
                service.publish(DETECTIONS.key(NAME), frame(6, detections=[]))
                await until(lambda: '"sequence": 6' in bridge.news(0).topics.get("detections", ""))
                service.image(5, b"five", annotated=False)
                image = await asked
                assert image is not None
                assert image.jpeg == b"five"
                assert image.about == {
                    "sequence": 5,
                    "captured_ns": 5,
                    "annotated": False,
                    "boxes": [BOX],
                    "boxes_sequence": 5,
                }
                # The same image is not sent twice. A frame that was not processed has the boxes before it.
                assert await bridge.image("", 5, 0.2) is None
                service.image(7)
                image = await bridge.image("", 5, 10.0)
                assert image is not None
                assert (image.about["sequence"], image.about["boxes_sequence"]) == (7, 6)


async def test_at_most_fifteen_images_a_second() -> None:
    with publishing() as (service, endpoint):
        async with bridging(endpoint) as fleet:
            await until(lambda: not fleet.problem)
            asked = asyncio.create_task(fleet.first.image("", -1, 20.0))
            await until(lambda: service.image_is_watched)
            shown: set[int] = set()

            async def show() -> None:
                image = await asked
                while image is not None:
                    shown.add(image.about["sequence"])
                    image = await fleet.first.image("", image.about["sequence"], 1.0)

            showing = asyncio.create_task(show())
            begun_s = time.monotonic()
            for number in range(36):  # at 18 Hz
                await asyncio.sleep(max(0.0, begun_s + number / 18 - time.monotonic()))
                service.image(number)
            lasted_s = time.monotonic() - begun_s
            await showing
            assert 8 < len(shown) <= 15 * lasted_s + 2


async def test_nothing_is_subscribed_without_a_browser() -> None:
    with publishing() as (service, endpoint):
        vehicle = service.session.declare_publisher(VEHICLE.key(NAME))

        def watched() -> bool:
            return bool(vehicle.matching_status.matching)  # type: ignore[attr-defined]

        async with bridging(endpoint) as fleet:
            bridge = fleet.first
            with fleet.watching(bridge):
                await until(watched)
                assert not service.image_is_watched
                assert await bridge.image("", -1, 0.3) is None
                await until(lambda: service.image_is_watched)
                with fleet.watching(bridge):
                    pass
                assert watched()
            await until(lambda: not watched())
            await until(lambda: not service.image_is_watched)


async def test_command_and_its_outcome() -> None:
    with publishing() as (service, endpoint):

        def answer(query: zenoh.Query) -> None:
            assert query.payload is not None
            text = query.payload.to_string()
            with query:
                reply = {"id": "s-3", "success": text == "land", "reason": f"got {text}", "track": 17}
                query.reply(query.key_expr, json.dumps(reply))

        service.session.declare_queryable(command_key(NAME), answer)
        async with bridging(endpoint) as fleet:
            await until(lambda: not fleet.problem)
            for text, success in (("land", True), ("follow track=17", False)):
                outcome = fleet.command(NAME, text, "id1")
                assert outcome is not None
                reply = {"command_id": "s-3", "success": success, "reason": f"got {text}", "track": 17}
                wanted = {"id": "id1", "command": text, "vehicle": NAME, **reply}
                assert await asyncio.wait_for(outcome, 20) == wanted
                assert fleet.replies(0)[1][-1] == wanted


async def test_stop_has_its_own_allowance_of_waiting_commands() -> None:
    with publishing() as (service, endpoint):
        queries: list[zenoh.Query] = []
        service.session.declare_queryable(command_key(NAME), queries.append)
        async with bridging(endpoint) as fleet:
            await until(lambda: not fleet.problem)
            waiting = [fleet.command(NAME, "hold", str(number)) for number in range(MAX_COMMANDS)]
            assert None not in waiting
            assert fleet.command(NAME, "hold", "more") is None
            await until(lambda: len(queries) == MAX_COMMANDS, 30.0)
            stop = fleet.command(NAME, " STOP", "stop")
            assert stop is not None
            await until(lambda: len(queries) == MAX_COMMANDS + 1, 30.0)
            service.token.undeclare()  # type: ignore[no-untyped-call]
            replies = await asyncio.gather(stop, *(one for one in waiting if one is not None))
            assert not any(reply["success"] for reply in replies)
            queries.clear()


async def test_no_service_and_a_service_that_goes_and_returns() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    async with bridging(endpoint) as fleet:
        bridge = fleet.first
        with fleet.watching(bridge):
            await until(lambda: "companion run" in fleet.problem)
            outcome = fleet.command(NAME, "land", "1")
            assert outcome is not None
            assert not (await outcome)["success"]
            with publishing(endpoint) as (service, _):
                await until(lambda: bridge.alive and not fleet.problem)
                service.publish(VEHICLE.key(NAME), {"mode": "hold"})
                await until(lambda: bridge.news(0).topics)
            await until(lambda: bridge.alive is False)
            await until(lambda: "lost" in fleet.problem)
            assert "vehicle" in bridge.news(0).ages_s
            with publishing(endpoint) as (service, _):
                await until(lambda: bridge.alive and not fleet.problem, 30.0)
                before = bridge.news(0).number

                def new() -> bool:
                    service.publish(VEHICLE.key(NAME), {"mode": "land"})
                    return bool(bridge.news(before).topics)

                await until(new, 30.0)
