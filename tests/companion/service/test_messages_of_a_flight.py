"""Every message of a whole flight is valid: simulator with depth, detector, markers, zenoh, MAVLink."""

from __future__ import annotations

import json
import queue
import uuid
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.bus.bodies.service import CommandReplyBody
from companion.bus.schema import schema_of
from companion.bus.topics import LARGE_TOPICS, TOPICS
from mavlink_sim.testing import QUICK_FLIGHT, running_simulator
from tests.companion.bus.message_check import check_message, closed
from tests.companion.service_process import running_service
from vision.weights import DEFAULT_EXPORT
from vision.yolo.checkpoint_pair import weights_sha256

pytestmark = pytest.mark.realtime

SCENE = """
name = "car and marker"
[ground]
kinds = ["concrete"]
tile_texels = 256
texel_m = 0.05
[[objects]]
class = "car"
place_m = [9.0, 0.0]
[[plates]]
dictionary = "4X4_50"
id = 7
size_m = 0.6
place_m = [4.0, 0.0]
[camera]
width = 320
height = 240
horizontal_fov_deg = 80
rate_hz = 3
[camera.mount]
pitch_deg = -25
"""


def test_every_message_of_a_flight_is_valid(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    camera = f"flight-{uuid.uuid4().hex[:8]}"
    second = tmp_path / "second.toml"
    second.write_text(
        f'[cameras.second.source]\nuri = "shm://{camera}"\n[cameras.second.detector]\nenabled = false\n'
    )
    flags = [
        "--source-uri", f"shm://{camera}", "--detector-image-size", "320",
        "--guidance-obstacles", "auto", "--guidance-avoid", "true", "--guidance-perception-max-age-s", "1.0",
        "--markers-dictionary", "4X4_50", "--markers-size-m", "0.6",
        "--config", str(second),
    ]  # fmt: skip
    samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    with (
        running_simulator(
            scene=scene, camera=camera, ready_after=0.0, seed=3, parameters=QUICK_FLIGHT
        ) as simulator,
        running_service(simulator.onboard_port, flags, cwd=tmp_path) as service,
        service.client() as session,
    ):
        session.declare_subscriber("companion/vehicle1/**", samples.put)
        replies: list[dict[str, Any]] = []
        service.take_off(2.5)
        for text in ("goto north=2 east=0", "dance", "land"):
            replies.append(service.command_when_it_can(text, 90.0))
    assert [reply["success"] for reply in replies] == [True, False, True], replies

    bodies: dict[str, list[Any]] = defaultdict(list)
    while not samples.empty():
        sample = samples.get()
        name = str(sample.key_expr).rpartition("/")[2]
        data = sample.attachment if name in {topic.name for topic in LARGE_TOPICS} else sample.payload
        assert data is not None
        body = data.to_string() if name == "labels" else json.loads(data.to_string())
        check_message(name, body)
        bodies[name].append(body)
    assert set(bodies) == {topic.name for topic in TOPICS}
    for reply in replies:
        closed_reply = closed(schema_of(CommandReplyBody))
        assert set(reply) <= set(closed_reply["properties"])

    # `goto` flies what the worker has planned.
    assert any(body["path_ned_m"] for body in bodies["setpoint"])
    frames = [body for body in bodies["detections"] if body["camera"] is None]
    assert {body["model_sha256"] for body in frames} == {weights_sha256(DEFAULT_EXPORT)}
    cars = [(body, car) for body in frames for car in body["detections"] if car["track_state"] == "confirmed"]
    assert cars
    located = [car for body, car in cars if car["position_ned_m"] and car["class_name"] == "car"]
    assert located
    # The car's nearest side, as seen from a few metres; the error of the vehicle's own estimate included.
    middle = sorted(located, key=lambda car: car["position_ned_m"][0])[len(located) // 2]
    assert 5.0 < middle["position_ned_m"][0] < 11.0
    assert middle["range_source"] == "depth"
    assert middle["range_sigma_m"] > 0.0
    assert min(middle["depth_sigma_m"], middle["distance_sigma_m"]) > 0.0
    state = next(body for body in bodies["vehicle"] if body["latitude_deg"] is not None)
    assert 0.0 < middle["latitude_deg"] - state["latitude_deg"] < 2e-4
    assert max(car["track_age_s"] for _, car in cars) > 1.0
    assert {body["targets"]["camera"] for body in bodies["status"]} == {None}  # the first one steers
    assert {body["camera"] for body in bodies["transforms"]} == {None, "second"}
    (lens,) = {tuple(body["k"]) for body in bodies["camera_info"] if body["camera"] is None}
    assert lens[2] == 159.5
