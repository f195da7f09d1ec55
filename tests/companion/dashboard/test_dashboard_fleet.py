"""Two vehicles on the bus: who is there, the map of both, commands to one and to all."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
import zenoh

from companion.bus.topics import DETECTIONS, SETPOINT, VEHICLE, command_key
from companion.dashboard.bridge import Bridge, Link
from companion.dashboard.fleet import MAX_VEHICLES
from companion.geometry.geodesy import latitude_longitude
from tests.companion.dashboard.serving import POST, EventStream, request, serving
from tests.companion.dashboard.test_bridge import NAME, Publisher, bridging, frame, publishing, until

pytestmark = pytest.mark.realtime

OTHER = "vehicle2"
HOME = (47.3977, 8.5456)
STARTS_M = {NAME: (0.0, 0.0), OTHER: (0.0, 5.0)}
"""Origins of local NED, north and east of `HOME`."""


@contextmanager
def two_vehicles() -> Iterator[tuple[dict[str, Publisher], str]]:
    with (
        publishing() as (first, endpoint),
        publishing(name=OTHER, connect=endpoint) as (second, _),
    ):
        yield {NAME: first, OTHER: second}, endpoint


def state_at(vehicle: str, north_m: float, east_m: float) -> dict[str, Any]:
    """The state of a vehicle at metres from its own origin."""
    start_north_m, start_east_m = STARTS_M[vehicle]
    latitude, longitude = latitude_longitude(HOME, start_north_m + north_m, start_east_m + east_m)
    return {
        "mode": "hold",
        "altitude_m": 3.0,
        "position_ned_m": [north_m, east_m, -3.0],
        "latitude_deg": latitude,
        "longitude_deg": longitude,
    }


def seen(track: int, north_m: float, east_m: float, **more: Any) -> dict[str, Any]:
    """An object at metres from `HOME`."""
    latitude, longitude = latitude_longitude(HOME, north_m, east_m)
    variance_m2 = 0.09
    return {
        "track_ids": [1, track],
        "class_name": "car",
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "covariance": [variance_m2, 0.0, 0.0, 0.0, 0.0, variance_m2],
        "confirmed": True,
        "last_ns": 5,
        **more,
    }


def detections(*objects: dict[str, Any]) -> dict[str, Any]:
    return frame(1, objects=list(objects), localization_error="")


def publish_scene(services: dict[str, Publisher]) -> None:
    """Both see a car 10 m north of `HOME`; the second one also a person."""
    services[NAME].publish(VEHICLE.key(NAME), state_at(NAME, 1.0, 0.0))
    services[NAME].publish(DETECTIONS.key(NAME), detections(seen(7, 10.0, 0.0)))
    services[OTHER].publish(VEHICLE.key(OTHER), state_at(OTHER, 2.0, 1.0))
    car, person = seen(3, 10.5, 0.2), seen(4, 0.0, 8.0, class_name="person")
    weak = seen(5, 0.0, 20.0, confirmed=False)
    unknown = [
        seen(6, 0.0, 30.0, track_ids=[]),
        seen(6, 0.0, 30.0, latitude_deg=None),
        seen(6, 0.0, 30.0, covariance=[-1.0] * 6),
        seen(6, 0.0, 30.0, covariance=[0.1] * 6),
    ]
    services[OTHER].publish(DETECTIONS.key(OTHER), detections(car, person, weak, *unknown))
    other = frame(1, objects=[], localization_error=None)
    services[OTHER].publish(DETECTIONS.key(OTHER, "down"), other)


async def test_page_of_either_vehicle_has_both_and_each_object_once() -> None:
    with two_vehicles() as (services, endpoint):
        async with bridging(endpoint) as fleet:
            other = fleet.bridge(OTHER)
            assert other is not None
            with fleet.watching(fleet.first):
                await until(lambda: fleet.first.alive and other.alive)

                def shown() -> bool:
                    publish_scene(services)
                    tracks = [track for one in fleet.objects(other) for track in one["tracks"]]
                    return len(fleet.vehicles(other)) == 2 and len(tracks) == 3

                await until(shown)
                # In local NED of the vehicle that is shown.
                for bridge, east_m in ((fleet.first, 0.0), (other, -5.0)):
                    first, second = fleet.vehicles(bridge)
                    assert (first["name"], first["mode"], first["alive"]) == (NAME, "hold", True)
                    assert first["at_ned_m"] == pytest.approx([1.0, east_m], abs=0.02)
                    assert second["at_ned_m"] == pytest.approx([2.0, east_m + 6.0], abs=0.02)
                    car, person = sorted(fleet.objects(bridge), key=lambda one: str(one["class_name"]))
                    assert car["tracks"] == [[NAME, 7], [OTHER, 3]]
                    assert car["at_ned_m"] == pytest.approx([10.25, east_m + 0.1], abs=0.02)
                    assert person["tracks"] == [[OTHER, 4]]
                    assert person["at_ned_m"] == pytest.approx([0.0, east_m + 8.0], abs=0.02)


@pytest.mark.parametrize("field", ["latitude_deg", "covariance", "track_ids", "last_ns"])
async def test_objects_that_are_no_numbers_are_none(field: str) -> None:
    text = json.dumps(detections(seen(6, 0.0, 30.0, **{field: "number"})))
    bridge = Bridge(Link(), OTHER)
    for number in ("1e999", "-1e999", '"x"', "null", "[]", "{}"):
        sample = SimpleNamespace(key_expr=DETECTIONS.key(OTHER), payload=text.replace('"number"', number))
        with patch("companion.dashboard.bridge._json", lambda sample: json.loads(sample.payload)):
            bridge._on_state(sample)  # type: ignore[arg-type]
        assert bridge.sightings() == [], number


async def test_vehicle_that_comes_later_is_listed_until_it_goes() -> None:
    with publishing() as (_, endpoint):
        async with bridging(endpoint) as fleet:
            with fleet.watching(fleet.first):
                await until(lambda: fleet.first.alive)

                def names() -> list[str]:
                    return [one["name"] for one in fleet.vehicles(fleet.first)]

                assert names() == [NAME]
                with publishing(name=OTHER, connect=endpoint) as (service, _):
                    await until(lambda: names() == [NAME, OTHER])
                    setpoint = service.session.declare_publisher(SETPOINT.key(OTHER))
                    await until(lambda: setpoint.matching_status.matching)  # type: ignore[attr-defined]
                await until(lambda: names() == [NAME])


async def test_no_vehicle_is_subscribed_without_a_page() -> None:
    with two_vehicles() as (services, endpoint):
        state = services[OTHER].session.declare_publisher(VEHICLE.key(OTHER))

        def watched() -> bool:
            return bool(state.matching_status.matching)  # type: ignore[attr-defined]

        async with bridging(endpoint) as fleet:
            await until(lambda: not fleet.problem)
            with fleet.watching(fleet.first):
                await until(watched)
            await until(lambda: not watched())


async def test_new_page_has_all_vehicles_in_its_first_message() -> None:
    with two_vehicles() as (_, endpoint):
        async with serving(endpoint) as port:
            async for news in stream_of(port, ""):
                if len(news["vehicles"]) == 2:
                    break
            # Switched to the other one, and without any page meanwhile.
            async for news in stream_of(port, f"?vehicle={OTHER}"):
                listed = [(one["name"], one["alive"]) for one in news["vehicles"]]
                assert listed == [(NAME, True), (OTHER, True)]
                break


async def test_number_of_kept_vehicles_is_limited() -> None:
    with publishing() as (_, endpoint):
        async with bridging(endpoint) as fleet:
            with fleet.watching(fleet.first):
                kept = [fleet.bridge(f"other{number}") for number in range(MAX_VEHICLES - 1)]
                for bridge in kept:
                    assert bridge is not None
                    bridge.set_alive(True)
                assert fleet.bridge("more") is None
                assert fleet.bridge("other3") is kept[3]
                kept[3].set_alive(False)  # type: ignore[union-attr]
                assert fleet.bridge("more") is not None
                assert fleet.bridge("other4") is kept[4]


def answering(services: dict[str, Publisher], **more: Any) -> list[tuple[str, str]]:
    """Answer the commands of all; returns the list of (vehicle, text) that is filled.

    Args:
        more: fields of the replies.
    """
    received: list[tuple[str, str]] = []

    def declare(name: str) -> None:
        def answer(query: zenoh.Query) -> None:
            assert query.payload is not None
            received.append((name, query.payload.to_string()))
            with query:
                query.reply(query.key_expr, json.dumps({"success": True, "reason": "holding", **more}))

        services[name].session.declare_queryable(command_key(name), answer)

    for name in services:
        declare(name)
    return received


async def test_command_reaches_its_vehicle_and_stop_all_reaches_all() -> None:
    with two_vehicles() as (services, endpoint):
        received = answering(services)
        async with serving(endpoint) as port:
            async for news in stream_of(port, f"?vehicle={OTHER}"):
                if len([one for one in news["vehicles"] if one["alive"]]) == 2:
                    break
            assert news["vehicle_name"] == OTHER
            status, _, body = await request(
                port, "POST", "/command", POST, {"text": "land", "vehicle": OTHER}
            )
            assert (status, json.loads(body)["vehicle"]) == (200, OTHER)
            assert received == [(OTHER, "land")]
            # Without an open page too.
            sent = {"text": "stop", "vehicle": "*", "id": "1"}
            status, _, body = await request(port, "POST", "/command", POST, sent)
            outcome = json.loads(body)
            assert (status, outcome["success"], outcome["id"]) == (200, True, "1")
            assert outcome["reason"] == f"{NAME}: holding; {OTHER}: holding"
            assert sorted(received[1:]) == [(NAME, "stop"), (OTHER, "stop")]


async def test_image_is_that_of_the_named_vehicle() -> None:
    with two_vehicles() as (services, endpoint):
        async with serving(endpoint) as port:
            for sequence in range(3, 200):
                for name, service in services.items():
                    service.image(sequence, name.encode())
                status, _, body = await request(port, "GET", f"/image?vehicle={OTHER}&after=-1")
                if status == 200:
                    break
            assert (status, body) == (200, OTHER.encode())
            assert services[OTHER].image_is_watched
            assert not services[NAME].image_is_watched


async def test_stop_all_without_a_vehicle_fails() -> None:
    async with serving() as port:
        status, _, body = await request(port, "POST", "/command", POST, {"text": "stop", "vehicle": "*"})
        assert (status, json.loads(body)["success"]) == (200, False)


async def stream_of(port: int, query: str) -> AsyncIterator[dict[str, Any]]:
    stream = await EventStream.open(port, query)
    try:
        while (news := await stream.next()) is not None:
            yield news
    finally:
        stream.close()
