"""`companion ros2 node` with nodes of a real ROS 2; the service is its side of the bus, or a real one."""

from __future__ import annotations

import asyncio
import base64
import json
import math
import os
import queue
import signal
import threading
import time
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh
from pymavlink.dialects.v20 import common as mavlink
from zenoh import SampleKind

from companion.bus.topics import CAMERA_INFO, DETECTIONS, IMAGE, LABELS, MAVLINK, VELOCITY, client_key
from companion.host.child_process import supervised
from companion.host.peer_data import parse_object
from companion.recording.link_bytes import unpack_link_bytes
from companion.ros2.cdr import encode
from companion.ros2.gateway import NodeTopic
from companion.ros2.process import RosNode, node_command
from companion.vehicle.framing import frames_of
from mavlink_sim.testing import running_simulator
from tests.companion.ros2.ros_process import (
    EACH_ROS,
    VEHICLE,
    WAIT_S,
    BusSide,
    bus,
    domain,
    process_of_node,
    ros_peer,
    running_node,
)
from tests.companion.service_process import running_service
from tests.programs import ROS_PYTHONS

__all__ = ["bus", "domain"]

pytestmark = [pytest.mark.realtime, pytest.mark.usefixtures("domain")]
JAZZY = EACH_ROS[:1]
STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
TWIST_MPS = 2.0
# Of guidance and of the setpoint stream together, by default; and what a busy computer adds.
PERIOD_S, LATE_S = 1 / 20 + 1 / 50, 0.1
LENS = {
    "stamp_ns": 0,
    "frame_id": "drone1/camera",
    "width": 64,
    "height": 48,
    "distortion_model": "plumb_bob",
    "d": [0.1, 0.0, 0.0, 0.0, 0.0],
    "k": [100.0, 0.0, 32.0, 0.0, 100.0, 24.0, 0.0, 0.0, 1.0],
    "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
    "p": [100.0, 0.0, 32.0, 0.0, 0.0, 100.0, 24.0, 0.0, 0.0, 0.0, 1.0, 0.0],
}


def stamp_ns(message: dict[str, Any]) -> int:
    stamp = message["header"]["stamp"]
    return int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])


def twist(forward_mps: float = 0.0, left_mps: float = 0.0) -> dict[str, Any]:
    return {"linear": {"x": forward_mps, "y": left_mps}}


@pytest.mark.parametrize("ros", EACH_ROS)
def test_node_and_its_topics_are_listed_with_their_types(ros: str, bus: BusSide) -> None:
    bus.put_status("down-left")
    with running_node(ros, bus.endpoint), ros_peer(ros) as peer:
        peer.graph_until(lambda graph: "/drone1/companion" in graph["nodes"])
        graph = peer.graph_until(lambda graph: "/drone1/cameras/down_left/labels" in graph["topics"])
    kinds = {name: kinds[0] for name, kinds in graph["topics"].items()}
    expected = {
        "/drone1/labels": STRING,
        "/drone1/image/compressed": "sensor_msgs/msg/CompressedImage",
        "/drone1/camera_info": "sensor_msgs/msg/CameraInfo",
        "/drone1/fix": "sensor_msgs/msg/NavSatFix",
        "/drone1/cameras/down_left/labels": STRING,
        "/drone1/object_to_seek": STRING,
        "/drone1/cmd_vel": TWIST,
        "/drone1/companion/command": STRING,
        "/drone1/companion/result": STRING,
    }
    assert {name: kinds.get(name) for name in expected} == expected
    assert "/drone1/cameras/down_left/fix" not in kinds


@pytest.mark.parametrize("ros", EACH_ROS)
def test_late_subscriber_gets_the_camera_info(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint), ros_peer(ros) as first, ros_peer(ros, name="late") as late:
        first.subscribe("/drone1/camera_info", "sensor_msgs/msg/CameraInfo", latched=True)
        bus.put(CAMERA_INFO, LENS)
        expected = first.message("/drone1/camera_info")
        assert expected["k"] == LENS["k"]
        assert expected["header"]["frame_id"] == "drone1/camera_optical"
        late.subscribe("/drone1/camera_info", "sensor_msgs/msg/CameraInfo", latched=True)
        assert late.message("/drone1/camera_info") == expected


@pytest.mark.parametrize("ros", EACH_ROS)
def test_compressed_image_has_the_same_pixels_and_stamp(ros: str, bus: BusSide) -> None:
    pixels = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    with running_node(ros, bus.endpoint), ros_peer(ros) as peer:
        peer.subscribe("/drone1/image/compressed", "sensor_msgs/msg/CompressedImage", reliable=False)
        bus.wait_for_reader(IMAGE)
        about = {"captured_ns": time.monotonic_ns(), "frame_id": 1}
        unix_ns = time.time_ns()
        message = peer.message_of("/drone1/image/compressed", lambda: bus.put(IMAGE, jpeg, about))
    expected = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(message["data"]), np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert expected is not None
    assert shown is not None
    assert expected is not None
    assert np.array_equal(shown, expected)
    assert abs(stamp_ns(message) - unix_ns) < 1_000_000


@pytest.mark.parametrize("ros", JAZZY)
def test_bus_is_read_only_while_a_node_subscribes(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint):
        with ros_peer(ros) as peer:
            peer.subscribe("/drone1/labels", STRING)
            bus.wait_for_reader(LABELS)
            assert not bus.publisher(IMAGE).matching_status.matching
        bus.wait_for_reader(LABELS, wanted=False)


@pytest.mark.parametrize("ros", JAZZY)
def test_killed_node_comes_back_with_one_event(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint) as node, ros_peer(ros) as peer:
        peer.subscribe("/drone1/labels", STRING)
        bus.wait_for_reader(LABELS)
        clients: queue.SimpleQueue[Any] = queue.SimpleQueue()
        key = client_key(VEHICLE, "*")
        watch = bus.session.liveliness().declare_subscriber(key, clients.put, history=True)
        assert clients.get(timeout=WAIT_S).kind == SampleKind.PUT
        noted = len(node.lines)
        os.kill(process_of_node(node), signal.SIGKILL)
        node.wait_for_line("code -9")
        node.wait_for_line("node: up: /drone1/companion", after=noted)
        bus.wait_for_reader(LABELS)
        assert peer.message_of("/drone1/labels", lambda: bus.put(LABELS, "car")) == {"data": "car"}
        node.last_lines()  # reads them
        assert sum("restarting" in line for line in node.lines) == 1
        kinds = [clients.get(timeout=WAIT_S).kind for _ in range(2)]
        watch.undeclare()  # type: ignore[no-untyped-call]
    assert kinds == [SampleKind.DELETE, SampleKind.PUT]  # the service makes one event of it


@pytest.mark.slow
@pytest.mark.parametrize("ros", JAZZY)
def test_stuck_node_is_killed_and_started_again(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint) as node:
        os.kill(process_of_node(node), signal.SIGSTOP)
        node.wait_for_line("no sign of life")
        node.wait_for_line("node: up: /drone1/companion", after=len(node.lines))


@pytest.mark.slow
@pytest.mark.parametrize("ros", JAZZY)
def test_second_node_of_the_same_name_is_reported(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint) as node, running_node(ros, bus.endpoint):
        assert "/drone1/companion" in node.wait_for_line("another node ", 60.0)


@pytest.mark.parametrize("ros", EACH_ROS)
def test_command_is_executed_and_answered_if_allowed(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint, "--ros2-commands", "true"), ros_peer(ros) as peer:
        peer.subscribe("/drone1/companion/result", STRING)
        peer.publish("/drone1/companion/command", STRING, {"data": "hold"})
        assert bus.commands.get(timeout=WAIT_S) == "hold"
        answer = json.loads(peer.message("/drone1/companion/result")["data"])
    assert (answer["command"], answer["success"], answer["reason"]) == ("hold", True, "done")


@pytest.mark.parametrize("ros", JAZZY)
def test_command_is_refused_with_a_reason_unless_allowed(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint), ros_peer(ros) as peer:
        peer.subscribe("/drone1/companion/result", STRING)
        for name, text in (("companion/command", "land"), ("object_to_seek", "car")):
            peer.publish(f"/drone1/{name}", STRING, {"data": text})
            answer = json.loads(peer.message("/drone1/companion/result")["data"])
            assert (answer["command"], answer["success"]) == (text, False)
            assert "ros2.commands" in answer["reason"]
    assert bus.commands.empty()


@pytest.mark.parametrize("ros", JAZZY)
def test_object_to_seek_is_sought_then_approached(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint, "--ros2-commands", "true"), ros_peer(ros) as peer:
        peer.subscribe("/drone1/companion/result", STRING)
        command = ""
        # The first one just after the start is none: it may be a repetition from before.
        for name in ("car", "traffic light"):
            peer.publish("/drone1/object_to_seek", STRING, {"data": name})
            assert json.loads(peer.message("/drone1/companion/result")["data"])["command"] == name
        while "traffic light" not in command:
            command = bus.commands.get(timeout=WAIT_S)
    assert command.startswith("mission object_to_seek\n")
    assert [step["do"] for step in tomllib.loads(command.partition("\n")[2])["step"]] == [
        'seek "traffic light"',
        'approach "traffic light"',
    ]


@pytest.mark.parametrize("ros", JAZZY)
def test_twist_becomes_a_velocity_and_nan_is_left_out(ros: str, bus: BusSide) -> None:
    received: list[dict[str, Any]] = []
    arrived = threading.Event()

    def on_velocity(sample: Any) -> None:
        received.append(parse_object(sample.payload.to_bytes()))
        arrived.set()

    subscriber = bus.session.declare_subscriber(VELOCITY.key(VEHICLE), on_velocity)
    with running_node(ros, bus.endpoint) as node, ros_peer(ros) as peer:
        peer.publish("/drone1/cmd_vel", TWIST, {"linear": {"x": float("nan")}}, times=20, hz=10)
        node.wait_for_line("finite")
        assert received == []
        moves = {"linear": {"x": 1.0, "y": 2.0, "z": 3.0}, "angular": {"z": 0.5}}
        peer.publish("/drone1/cmd_vel", TWIST, moves, times=20, hz=10)
        assert arrived.wait(WAIT_S)
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    velocity = received[0]
    names = ("forward_mps", "right_mps", "up_mps", "turn_radps")
    assert [velocity[name] for name in names] == [1.0, -2.0, 3.0, -0.5]


@pytest.mark.parametrize("ros", EACH_ROS)
def test_velocity_has_the_type_of_its_publishers(ros: str, bus: BusSide) -> None:
    received: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    subscriber = bus.session.declare_subscriber(
        VELOCITY.key(VEHICLE), lambda sample: received.put(parse_object(sample.payload.to_bytes()))
    )
    with running_node(ros, bus.endpoint) as node:
        for speed_mps, kind in ((1.0, TWIST_STAMPED), (2.0, TWIST)):
            message = twist(speed_mps) if kind == TWIST else {"twist": twist(speed_mps)}
            with ros_peer(ros) as peer:
                peer.publish("/drone1/cmd_vel", kind, message, times=1000, hz=20)
                while received.get(timeout=WAIT_S)["forward_mps"] != speed_mps:
                    pass
        node.last_lines()
        assert not any("left out" in line for line in node.lines)
    subscriber.undeclare()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("ros", JAZZY)
def test_velocity_that_waited_in_a_stopped_node_is_left_out(ros: str, bus: BusSide) -> None:
    received: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    subscriber = bus.session.declare_subscriber(
        VELOCITY.key(VEHICLE), lambda sample: received.put(parse_object(sample.payload.to_bytes()))
    )
    with running_node(ros, bus.endpoint) as node, ros_peer(ros) as peer:
        peer.publish("/drone1/cmd_vel", TWIST, twist(1.0), times=10, hz=20)
        peer.wait_for(lambda line: "published" in line)
        received.get(timeout=WAIT_S)
        os.kill(process_of_node(node), signal.SIGSTOP)
        try:
            peer.publish("/drone1/cmd_vel", TWIST, twist(5.0), times=3, hz=20)  # Fast DDS keeps them for 1 s
            peer.wait_for(lambda line: "published" in line)
            time.sleep(0.6)  # they become old
        finally:
            os.kill(process_of_node(node), signal.SIGCONT)
        peer.publish("/drone1/cmd_vel", TWIST, twist(2.0), times=10, hz=20)
        speeds_mps = []
        while 2.0 not in speeds_mps:
            speeds_mps.append(received.get(timeout=WAIT_S)["forward_mps"])
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    assert set(speeds_mps) == {1.0, 2.0}


@pytest.mark.parametrize("ros", JAZZY)
def test_command_of_100_kb_is_left_out_with_its_size(ros: str, bus: BusSide) -> None:
    with running_node(ros, bus.endpoint) as node, ros_peer(ros) as peer:
        peer.publish("/drone1/companion/command", STRING, {"data": "x" * 100_000})
        line = node.wait_for_line("left out")
    assert "~/command" in line
    assert "65536" in line
    assert bus.commands.empty()


@pytest.mark.parametrize("ros", JAZZY)
def test_stamps_are_of_simulated_time_while_there_is_one(ros: str, bus: BusSide) -> None:
    with (
        running_node(ros, bus.endpoint, "--", "--ros-args", "-p", "use_sim_time:=true"),
        ros_peer(ros) as peer,
    ):
        clock = {"clock": {"sec": 5000}}
        peer.publish("/clock", "rosgraph_msgs/msg/Clock", clock, times=100_000, hz=50.0)
        peer.subscribe("/drone1/camera_info", "sensor_msgs/msg/CameraInfo", latched=True)
        deadline_s = time.monotonic() + WAIT_S
        while True:
            bus.put(CAMERA_INFO, LENS | {"stamp_ns": time.monotonic_ns()})
            stamp = peer.message("/drone1/camera_info")["header"]["stamp"]["sec"]
            if stamp in (4999, 5000):
                break
            assert time.monotonic() < deadline_s, stamp
            time.sleep(0.1)


@pytest.mark.parametrize("ros", JAZZY)
def test_names_are_remapped_by_the_arguments_of_ros(ros: str, bus: BusSide) -> None:
    remaps = ("--ros-args", "-r", "__ns:=/alpha", "-r", "__node:=eye", "-r", "cmd_vel:=/cmd_vel")
    with running_node(ros, bus.endpoint, "--", *remaps), ros_peer(ros) as peer:
        peer.graph_until(lambda graph: "/alpha/eye" in graph["nodes"])
        expected = {"/alpha/labels", "/alpha/eye/command", "/cmd_vel"}
        peer.graph_until(lambda graph: expected <= graph["topics"].keys())
        peer.subscribe("/alpha/camera_info", "sensor_msgs/msg/CameraInfo", latched=True)
        bus.put(CAMERA_INFO, LENS)
        assert peer.message("/alpha/camera_info")["header"]["frame_id"] == "alpha/camera_optical"


@pytest.mark.parametrize("ros", JAZZY)
def test_node_waits_for_a_service_that_starts_later(ros: str) -> None:
    first = BusSide()
    first.close()
    with running_node(ros, first.endpoint, ready="retrying") as node:
        late = BusSide(endpoint=first.endpoint)
        try:
            node.wait_for_line("node: up: /drone1/companion")
        finally:
            late.close()


@pytest.mark.parametrize("ros", JAZZY)
def test_node_refused_by_ros_is_one_line_and_exit_code_2(ros: str, bus: BusSide) -> None:
    with (
        pytest.raises(AssertionError),
        running_node(
            ros, bus.endpoint, "--", "--ros-args", "-r", "__node:=no-name", ready="companion: "
        ) as node,
    ):
        assert node.process.wait(WAIT_S) == 2


def speed_mps(vehicle: dict[str, Any]) -> float:
    north, east, _ = vehicle["velocity_ned_mps"]
    return float(np.hypot(north, east))


class Steering:
    """When velocities came from ROS, and which setpoints were sent to the autopilot: CLOCK_MONOTONIC, ns."""

    def __init__(self, session: zenoh.Session) -> None:
        self.twists_ns: list[int] = []
        self.setpoints: list[tuple[int, float]] = []  # when, and its horizontal speed, m/s
        self._decoder = mavlink.MAVLink(None)
        self._kept = [
            session.declare_subscriber(VELOCITY.key("vehicle1"), self._on_velocity),
            session.declare_subscriber(MAVLINK.key("vehicle1"), self._on_link_bytes),
        ]

    def _on_velocity(self, sample: zenoh.Sample) -> None:
        self.twists_ns.append(parse_object(sample.payload.to_bytes())["stamp_ns"])

    def _on_link_bytes(self, sample: zenoh.Sample) -> None:
        for _, piece in unpack_link_bytes(sample.payload.to_bytes()):
            for frame in frames_of(piece.data) if piece.sent else ():
                if frame.message_id == mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED:
                    message = self._decoder.decode(bytearray(frame.raw))
                    self.setpoints.append((piece.stamp_ns, math.hypot(message.vx, message.vy)))

    def slowed_after_s(self, share: float) -> float:
        """From the newest velocity to the first setpoint below a share of the slowest in the 0.5 s before it.

        Braking is limited by `guidance.max_acceleration_mps2`.
        """
        last_ns = self.twists_ns[-1]
        steered_mps = min(mps for ns, mps in self.setpoints if -500_000_000 < ns - last_ns < 0)
        slower_ns = next(ns for ns, mps in self.setpoints if ns > last_ns and mps < share * steered_mps)
        return (slower_ns - last_ns) / 1e9


@pytest.mark.parametrize("ros", JAZZY)
def test_cmd_vel_steers_silence_brakes_and_a_killed_node_is_one_event(
    ros: str, filming: list[str], tmp_path: Path
) -> None:
    with (
        running_simulator(ready_after=0.0) as simulator,
        running_service(simulator.onboard_port, filming, cwd=tmp_path) as service,
        running_node(ros, service.endpoint, vehicle="vehicle1") as node,
        ros_peer(ros) as peer,
        service.client() as session,
    ):
        service.take_off(3.0)
        events: queue.SimpleQueue[str] = queue.SimpleQueue()
        listening = session.declare_subscriber(
            "companion/vehicle1/events",
            lambda sample: events.put(parse_object(sample.payload.to_bytes())["text"]),
        )
        states: list[dict[str, Any]] = []
        subscriber = session.declare_subscriber(
            "companion/vehicle1/vehicle",
            lambda sample: states.append(parse_object(sample.payload.to_bytes())),
        )
        steering = Steering(session)
        running = threading.Thread(target=service.command, args=("velocity",), daemon=True)
        running.start()
        peer.publish("/vehicle1/cmd_vel", TWIST, twist(TWIST_MPS), times=100, hz=20.0)
        peer.wait_for(lambda line: "published" in line)
        assert max(speed_mps(state) for state in states) > 1.5
        deadline_s = time.monotonic() + 10.0
        while speed_mps(states[-1]) > 0.3:
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        brakes_s, half_s = steering.slowed_after_s(0.95), steering.slowed_after_s(0.5)
        noted, earlier = len(node.lines), events.qsize()
        os.kill(process_of_node(node), signal.SIGKILL)
        node.wait_for_line("node: up: /vehicle1/companion", after=noted)
        killed = [events.get(timeout=WAIT_S) for _ in range(earlier + 1)][earlier:]
        peer.publish("/vehicle1/cmd_vel", TWIST, twist(TWIST_MPS), times=300, hz=20.0)
        deadline_s = time.monotonic() + 15.0  # a new node is first found by the publisher
        while speed_mps(states[-1]) < 1.5:  # under the same command `velocity`
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        killed += [events.get() for _ in range(events.qsize())]
        listening.undeclare()  # type: ignore[no-untyped-call]
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    assert VELOCITY.max_age_s is not None
    assert VELOCITY.max_age_s < brakes_s < VELOCITY.max_age_s + PERIOD_S + LATE_S
    assert half_s < brakes_s + 1.0
    assert sum("ros2-node" in text for text in killed) == 1, killed


def detections_body(number: int) -> dict[str, Any]:
    """A frame with some detections and an object."""
    chance = np.random.default_rng(number)
    found = []
    for index in range(number % 4):
        left, top, width, height = chance.uniform(0, 300, 4).tolist()
        found.append(
            {
                "xyxy": [left, top, left + width, top + height],
                "center": [left + width / 2, top + height / 2],
                "class_name": ("car", "Fußgänger")[index % 2],
                "confidence": float(chance.uniform()),
                "track_id": None if index == 2 else number * 10 + index,
                "nearest_camera_m": None if index else chance.uniform(0, 9, 3).tolist(),
                "object_id": None if index else number,
            }
        )
    return {"captured_ns": time.monotonic_ns(), "detections": found, "objects": []}


def point(values: list[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


@pytest.mark.parametrize("ros", EACH_ROS)
def test_300_of_300_detections_arrive_with_every_field(ros: str, bus: BusSide) -> None:
    name = "/drone1/detections"
    with running_node(ros, bus.endpoint), ros_peer(ros) as peer:
        peer.subscribe(name, "vision_msgs/msg/Detection2DArray")
        bus.wait_for_reader(DETECTIONS)
        peer.message_of(name, lambda: bus.put(DETECTIONS, detections_body(0)))
        offset_ns = time.time_ns() - time.monotonic_ns()
        sent, begin_s = [], time.monotonic()
        for number in range(1, 301):
            sent.append(detections_body(number))
            bus.put(DETECTIONS, sent[-1])
            time.sleep(max(0.0, begin_s + number / 30.0 - time.monotonic()))
        received: list[dict[str, Any]] = []
        while len(received) < 300:
            message = peer.message(name)
            if stamp_ns(message) - offset_ns > sent[0]["captured_ns"] - 1_000_000:  # else sent before
                received.append(message)
    stamps = zip(map(stamp_ns, received), sent, strict=True)
    assert max(abs(stamp - body["captured_ns"] - offset_ns) for stamp, body in stamps) < 1_000_000
    for message, body in zip(received, sent, strict=True):
        header = message["header"]
        assert header["frame_id"] == "drone1/camera_optical"
        for found, expected in zip(message["detections"], body["detections"], strict=True):
            (result,) = found["results"]
            assert found["header"] == header
            assert result["hypothesis"] == {
                "class_id": expected["class_name"],
                "score": expected["confidence"],
            }
            assert found["id"] == ("" if expected["track_id"] is None else str(expected["track_id"]))
            left, top, right, bottom = expected["xyxy"]
            box = found["bbox"]
            assert (box["size_x"], box["size_y"]) == (right - left, bottom - top)
            assert [box["center"]["position"][axis] for axis in "xy"] == expected["center"]
            assert result["pose"]["pose"]["position"] == point(expected["nearest_camera_m"] or [0.0] * 3)


@pytest.mark.parametrize("ros", EACH_ROS)
def test_raw_images_of_900_kb_reach_the_parent_at_30_hz(ros: str, domain: int) -> None:
    received: list[tuple[str, str, int, int, int]] = []

    def on_serialized(
        name: str, kind: str, payload: memoryview, received_ns: int, ros_ns: int, age_ns: int
    ) -> None:
        assert 0 < age_ns < WAIT_S * 1e9
        received.append((name, kind, len(payload), received_ns, ros_ns))

    ready = threading.Event()
    node = RosNode(
        node_command(str(ROS_PYTHONS[ros]), "companion", "drone1"),
        os.environ,
        on_ready=lambda _name, _namespace: ready.set(),
        on_clock=lambda _monotonic_ns, _ros_ns, _simulated: None,
        say=print,
    )
    image = "sensor_msgs/msg/Image"
    node.declare(
        NodeTopic(
            *("camera/image_raw", image, on_serialized),
            reliable=False,
            depth=2,
            adapts=True,
            largest_bytes=2**24,
        )
    )

    async def until_received() -> None:
        async with supervised("node", node.start, print):
            assert await asyncio.to_thread(ready.wait, WAIT_S)
            await asyncio.to_thread(send)

    def send() -> None:
        with ros_peer(ros) as peer:
            frame = {"height": 480, "width": 640, "encoding": "bgr8", "step": 1920}
            data = {"zeros": 921_600}
            peer.publish(
                "/drone1/camera/image_raw", image, {**frame, "data": data}, times=90, hz=30.0, depth=5
            )
            peer.wait_for(lambda line: "published" in line)

    asyncio.run(until_received())
    assert {each[:2] for each in received} == {("camera/image_raw", image)}
    assert min(size for _, _, size, _, _ in received) > 921_600
    assert len(received) >= 80, len(received)
    offset_ns = time.time_ns() - time.monotonic_ns()
    errors_ns = sorted(abs(ros_ns - received_ns - offset_ns) for *_, received_ns, ros_ns in received)
    assert errors_ns[len(errors_ns) // 2] < 1_000_000  # between the two readings the process may wait


@pytest.mark.parametrize("ros", JAZZY)
def test_missing_package_is_named_and_the_rest_works(ros: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    lines: list[str] = []
    ready, received = threading.Event(), threading.Event()
    node = RosNode(
        node_command(str(ROS_PYTHONS[ros]), "companion", ""),
        os.environ,
        on_ready=lambda _name, _namespace: ready.set(),
        on_clock=lambda _monotonic_ns, _ros_ns, _simulated: None,
        say=lines.append,
    )
    node.declare(
        NodeTopic("one", "no_such_msgs/msg/One"),
        NodeTopic("two", "no_such_msgs/msg/Two"),
        NodeTopic("three", "std_msgs/msg/NoSuch"),
        NodeTopic("text", STRING),
        NodeTopic("/text", STRING, lambda *_: received.set()),
    )

    def work() -> None:
        deadline_s = time.monotonic() + WAIT_S
        while not received.wait(0.1):
            node.send("text", encode(STRING, {"data": "ü"}))
            assert time.monotonic() < deadline_s

    async def until_received() -> None:
        async with supervised("node", node.start, lines.append):
            await asyncio.to_thread(work)

    asyncio.run(until_received())
    (missing,) = (line for line in lines if "no_such_msgs" in line)
    assert "ros-jazzy-no-such-msgs" in missing
    assert "one, two" in missing
    assert sum("three" in line for line in lines) == 1
