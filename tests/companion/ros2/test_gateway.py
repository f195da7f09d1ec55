"""The gateway without ROS: names, the clock of the service, and that only what is wanted is read."""

from __future__ import annotations

import ast
import asyncio
import json
import queue
import re
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.bus import topics
from companion.bus.client import client_settings, open_client
from companion.bus.topics import LABELS, VELOCITY
from companion.guidance.missions.mission_file import plan_from
from companion.host.peer_data import parse_object
from companion.ros2 import node as node_file
from companion.ros2.cdr import decode, encode
from companion.ros2.gateway import Gateway, NodeTopic, ServiceClock
from companion.ros2.messages import OUTPUT_TOPICS, Messages, frame_prefix, ros_name, topic_name
from companion.ros2.process import Ros2Error, find_python, run_node
from companion.ros2.requests import STRING, TWIST, TWIST_STAMPED, Requests, _mission
from companion.ros2.wiring import connected, namespace_of
from companion.settings import Settings, ZenohSection
from tests.companion.ros2.bus_samples import payload_of
from tests.companion.ros2.ros_process import VEHICLE, WAIT_S, BusSide, bus

__all__ = ["bus"]

BY_NAME = {topic.name: topic for topic in OUTPUT_TOPICS}


def settings(**ros2: Any) -> Settings:
    return Settings.model_validate({"vehicle": {"name": "drone-1"}, "ros2": ros2})


def test_namespace_is_the_vehicle_or_the_setting() -> None:
    assert namespace_of(settings()) == "drone_1"
    assert namespace_of(settings(namespace="fleet/one")) == "fleet/one"
    assert namespace_of(settings(namespace="")) == ""
    assert (frame_prefix("a"), frame_prefix("")) == ("a/", "")


@pytest.mark.parametrize("wrong", ["/drone", "drone/", "4x", "a b", "a//b"])
def test_namespace_that_ros_would_refuse_is_refused(wrong: str) -> None:
    with pytest.raises(ValueError, match=r"ros2\.namespace"):
        settings(namespace=wrong)


@given(st.text(st.characters(codec="ascii", categories=("L", "N", "P")), min_size=1))
def test_any_name_becomes_one_of_ros(name: str) -> None:
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", ros_name(name))


def test_topics_of_further_cameras_have_their_name() -> None:
    assert topic_name(BY_NAME["labels"], None) == "labels"
    assert topic_name(BY_NAME["labels"], "down-left") == "cameras/down_left/labels"
    assert topic_name(BY_NAME["/tf"], "down-left") == "/tf"


def test_node_file_is_python_3_10_of_the_standard_library_and_rclpy() -> None:
    text = Path(node_file.__file__).read_text()
    tree = ast.parse(text, feature_version=(3, 10))
    names = {
        alias.name.partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    }
    names |= {
        (node.module or "").partition(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
    }
    assert names - sys.stdlib_module_names == {"rclpy"}
    line = f"ruff check --isolated --target-version py310 --select F,E9 {node_file.__file__}"
    done = subprocess.run([sys.executable, "-m", *line.split()], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_stamps_on_this_host_follow_its_system_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ServiceClock()
    now_ns = time.monotonic_ns()
    clock.on_status(time.time_ns() - now_ns)
    assert abs(clock.ros_time_ns(now_ns) - time.time_ns()) < 50_000_000
    unix_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: unix_ns() + 3600 * 10**9)  # it is set
    stamps = [clock.ros_time_ns(time.monotonic_ns())]
    clock.on_status(time.time_ns() - time.monotonic_ns())
    stamps.append(clock.ros_time_ns(time.monotonic_ns()))
    for stamp in stamps:
        assert stamp - unix_ns() > 3599 * 10**9


def test_stamps_of_another_host_follow_its_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = ServiceClock()
    clock.on_status(7 * 10**15)
    assert abs(clock.ros_time_ns(10**9) - (7 * 10**15 + 10**9)) < 1_000_000
    unix_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: unix_ns() + 3600 * 10**9)  # this host's is set
    clock.on_status(7 * 10**15)
    assert abs(clock.ros_time_ns(2 * 10**9) - (7 * 10**15 + 2 * 10**9)) < 1_000_000


def test_simulated_stamps_of_another_host_are_those_of_clock_here() -> None:
    clock = ServiceClock()
    now_ns = time.monotonic_ns()
    there_ns = now_ns - 10**15  # its CLOCK_MONOTONIC at this moment
    clock.on_status(time.time_ns() - there_ns)
    clock.on_ros_time(now_ns, 50 * 10**9, True)
    assert abs(clock.ros_time_ns(there_ns) - 50 * 10**9) < 50_000_000


def test_stamps_are_of_simulated_time_while_there_is_one_for_the_clock() -> None:
    clock = ServiceClock()
    now_ns = time.monotonic_ns()
    clock.on_status(time.time_ns() - time.monotonic_ns())
    clock.on_ros_time(now_ns, 50 * 10**9, True)
    assert clock.ros_time_ns(now_ns - 10**9) == 49 * 10**9
    assert clock.ros_time_ns(now_ns - 60 * 10**9) == 0  # before the simulation began
    clock.on_ros_time(now_ns, time.time_ns(), False)
    assert abs(clock.ros_time_ns(now_ns) - time.time_ns()) < 10**9


class ListNode:
    """Keeps what is declared and published."""

    def __init__(self) -> None:
        self.topics: dict[str, NodeTopic] = {}
        self.declared: list[str] = []
        self.published: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()

    def declare(self, *topics: NodeTopic) -> None:
        self.topics.update((topic.name, topic) for topic in topics)
        self.declared += [topic.name for topic in topics]

    def send(self, name: str, payload: bytes) -> None:
        self.published.put((name, payload))

    def want(self, name: str, wanted: bool = True) -> None:
        on_wanted = self.topics[name].on_wanted
        assert on_wanted is not None
        on_wanted(wanted)


@pytest.mark.realtime
def test_bus_is_read_while_any_node_wants_it(bus: BusSide) -> None:
    lines: list[str] = []
    with open_client(client_settings(ZenohSection(listen=(bus.endpoint,)))) as session:
        nodes = first, second = ListNode(), ListNode()
        gateway = Gateway(session, VEHICLE, Messages("", lambda ns: ns), nodes, lines.append)
        gateway.offer(None)
        for node in (first, first, second):  # the same again changes nothing
            node.want("labels")
        bus.wait_for_reader(LABELS)
        bus.put(LABELS, "car")
        for node in nodes:
            name, payload = node.published.get(timeout=WAIT_S)
            assert (name, decode(STRING, payload)) == ("labels", {"data": "car"})
        first.want("labels", False)
        bus.put(LABELS, b"\xff")  # not text: said, and the next one is used
        bus.put(LABELS, "boat")
        assert decode(STRING, second.published.get(timeout=WAIT_S)[1]) == {"data": "boat"}
        assert first.published.empty()
        assert len(lines) == 1
        second.want("labels", False)
        bus.wait_for_reader(LABELS, wanted=False)
        gateway.close()


@pytest.mark.realtime
def test_topic_that_cannot_be_made_keeps_no_other_back(bus: BusSide) -> None:
    """Of a vehicle without its battery; as the battery is wanted by two, it is one loss."""
    lines: list[str] = []
    body = json.loads(payload_of(topics.VEHICLE)[0])
    del body["battery_fraction"]
    with open_client(client_settings(ZenohSection(listen=(bus.endpoint,)))) as session:
        nodes = first, second = ListNode(), ListNode()
        gateway = Gateway(session, VEHICLE, Messages("", lambda ns: ns), nodes, lines.append)
        gateway.offer(None)
        for node, name in ((second, "battery"), (first, "battery"), (first, "fix"), (first, "pose")):
            node.want(name)
        bus.wait_for_reader(topics.VEHICLE)
        bus.put(topics.VEHICLE, body)
        names = {first.published.get(timeout=WAIT_S)[0] for _ in range(2)}
        gateway.close()
    assert names == {"fix", "pose"}
    assert second.published.empty()
    assert len(lines) == 1
    assert "BatteryState" in lines[0]


@pytest.mark.realtime
def test_images_get_camera_info_but_it_alone_needs_no_image(bus: BusSide) -> None:
    with open_client(client_settings(ZenohSection(listen=(bus.endpoint,)))) as session:
        node = ListNode()
        gateway = Gateway(session, VEHICLE, Messages("", lambda ns: ns), [node], print)
        gateway.offer(None)
        node.want("camera_info")
        bus.put(topics.CAMERA_INFO, json.loads(payload_of(topics.CAMERA_INFO)[0]))
        assert node.published.get(timeout=WAIT_S)[0] == "camera_info"
        assert not bus.publisher(topics.IMAGE).matching_status.matching
        node.want("image/compressed")
        bus.wait_for_reader(topics.IMAGE)
        jpeg, about = payload_of(topics.IMAGE)
        bus.put(topics.IMAGE, jpeg, json.loads(about or b""))
        made = dict(node.published.get(timeout=WAIT_S) for _ in range(2))
        image = decode(BY_NAME["image/compressed"].type_name, made["image/compressed"])
        info = decode(BY_NAME["camera_info"].type_name, made["camera_info"])
        assert info["header"] == image["header"]
        gateway.close()


@pytest.mark.realtime
def test_cameras_of_the_status_are_followed(bus: BusSide) -> None:
    bus.put_status("down")
    with open_client(client_settings(ZenohSection(listen=(bus.endpoint,)))) as session:
        node, vehicle = ListNode(), Settings.model_validate({"vehicle": {"name": VEHICLE}})
        with connected(session, vehicle, "", ServiceClock(), [node], print):
            wait_until(lambda: "cameras/down/labels" in node.topics)
            assert "cameras/down/fix" not in node.topics


@pytest.mark.realtime
def test_camera_whose_topics_another_one_has_is_named(bus: BusSide) -> None:
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    bus.put_status("a_b", "a-b", "c")
    with open_client(client_settings(ZenohSection(listen=(bus.endpoint,)))) as session:
        node, vehicle = ListNode(), Settings.model_validate({"vehicle": {"name": VEHICLE}})
        with connected(session, vehicle, "", ServiceClock(), [node], lines.put):
            wait_until(lambda: "cameras/c/labels" in node.topics)
    assert node.declared.count("cameras/a_b/labels") == 1
    (line,) = (line for line in (lines.get_nowait() for _ in range(lines.qsize())) if "camera" in line)
    assert "'a-b'" in line
    assert "'a_b'" in line


def test_python_without_rclpy_is_one_line_with_what_to_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    with pytest.raises(Ros2Error) as raised:
        find_python(sys.executable)
    assert "source /opt/ros/" in str(raised.value)
    assert sys.executable in str(raised.value)
    assert "\n" not in str(raised.value)
    with pytest.raises(Ros2Error, match="no_such_python"):
        find_python("/no_such_python")


@pytest.mark.parametrize("uri", ["ros://cam?info=camera_info", "ros://cameras/down/image"])
def test_source_that_the_node_itself_publishes_is_refused(uri: str) -> None:
    values = {"source": {"uri": uri}, "ros2": {"namespace": ""}, "cameras": {"down": {}}}
    with pytest.raises(Ros2Error, match=r"ros2\.namespace"):
        asyncio.run(run_node(Settings.model_validate(values), "", (), threading.Event(), print))


def test_command_without_ros_has_exit_code_2() -> None:
    command = [sys.executable, "-m", "companion.cli", "ros2", "node", "--python", sys.executable]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)


@pytest.fixture
def requests(bus: BusSide, request: pytest.FixtureRequest) -> Any:
    results: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()

    def on_result(payload: bytes) -> None:
        results.put(json.loads(decode(STRING, payload)["data"]))

    with open_client(client_settings(ZenohSection(listen=(bus.endpoint,)))) as session:
        made = Requests(session, VEHICLE, commands=True, publish_result=on_result, say=print)
        yield made, results


def text_of(text: str) -> memoryview:
    return memoryview(encode(STRING, {"data": text}))


def later_ns() -> int:
    """A time at which no publisher has repeated its text since before the start."""
    return time.monotonic_ns() + 60 * 10**9


@pytest.mark.realtime
@pytest.mark.parametrize("name", ['car" distance=0', "car\nland", "x" * 65])
def test_object_that_is_no_name_of_a_class_is_refused(name: str, bus: BusSide, requests: Any) -> None:
    made, results = requests
    made.on_object("object_to_seek", STRING, text_of(name), later_ns(), 0)
    assert results.get(timeout=WAIT_S)["success"] is False
    assert bus.commands.empty()


@pytest.mark.realtime
@pytest.mark.parametrize("name", ["car", "traffic light", "driver's hut", "Mäher"])
def test_object_is_one_mission_that_seeks_and_approaches(name: str, bus: BusSide, requests: Any) -> None:
    made, results = requests
    made.on_object("object_to_seek", STRING, text_of(name), later_ns(), 0)
    assert results.get(timeout=WAIT_S)["command"] == name
    command, _, text = bus.commands.get(timeout=WAIT_S).partition("\n")
    assert command == "mission object_to_seek"
    steps = tomllib.loads(text)["step"]
    assert [step["do"] for step in steps] == [f'seek "{name}"', f'approach "{name}"']


def test_mission_of_an_object_can_be_flown() -> None:
    plan = plan_from(_mission("car").partition("\n")[2], "object_to_seek", ("car",))
    assert len(plan.steps) == 2


@pytest.mark.realtime
def test_repeated_object_does_not_take_the_vehicle_back(bus: BusSide, requests: Any) -> None:
    """The pilot or another command has ended the search; there was a gap of the network of a minute."""
    made, results = requests
    bus.reply = {"success": False, "reason": "the pilot took over: hold mode"}
    begin_ns = later_ns()
    for second in (*range(10), *range(70, 80)):
        made.on_object("object_to_seek", STRING, text_of("car"), begin_ns + second * 10**9, 0)
        assert results.get(timeout=WAIT_S)["success"] is False
        wait_until(lambda: made._running.total() == 0)
    assert bus.received == 1
    made.on_object("object_to_seek", STRING, text_of(""), begin_ns, 0)  # the end of the repetition
    made.on_object("object_to_seek", STRING, text_of("car"), begin_ns, 0)
    wait_until(lambda: bus.received == 2)


@pytest.mark.realtime
def test_repeated_command_is_one_command_but_stop_is_always_one(bus: BusSide, requests: Any) -> None:
    made, results = requests
    begin_ns = later_ns()
    for text, seconds, commands in (
        ("seek car", range(30), 1),
        ("seek car", (45,), 2),
        ("stop", (46, 47), 4),
    ):
        for second in seconds:
            made.on_command("~/command", STRING, text_of(text), begin_ns + second * 10**9, 0)
            assert results.get(timeout=WAIT_S)["command"] == text
            wait_until(lambda: made._running.total() == 0)
        assert bus.received == commands


@pytest.mark.realtime
def test_object_repeated_since_before_the_start_is_no_request(bus: BusSide, requests: Any) -> None:
    made, results = requests
    for _ in range(3):
        made.on_object("object_to_seek", STRING, text_of("car"), time.monotonic_ns(), 0)
        assert results.get(timeout=WAIT_S)["success"] is False
    assert bus.received == 0
    made.on_object("object_to_seek", STRING, text_of("boat"), time.monotonic_ns(), 0)
    wait_until(lambda: bus.received == 1)


@pytest.mark.realtime
def test_same_object_again_changes_nothing_a_new_one_replaces_it(bus: BusSide, requests: Any) -> None:
    made, _ = requests
    answering = threading.Event()
    bus.before_reply = lambda: answering.wait(WAIT_S)
    for name in ("car", "car", "boat"):
        made.on_object("object_to_seek", STRING, text_of(name), later_ns(), 0)
        if name == "car":
            wait_until(lambda: bus.received >= 1)
    answering.set()
    commands = [bus.commands.get(timeout=WAIT_S) for _ in range(2)]
    assert ["boat" in command for command in sorted(commands)] == [True, False]


@pytest.fixture
def velocities(bus: BusSide, requests: Any) -> Iterator[queue.SimpleQueue[dict[str, Any]]]:
    received: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    subscriber = bus.session.declare_subscriber(
        VELOCITY.key(VEHICLE), lambda sample: received.put(parse_object(sample.payload.to_bytes()))
    )
    wait_until(lambda: requests[0]._velocities.matching_status.matching)
    yield received
    subscriber.undeclare()  # type: ignore[no-untyped-call]


@pytest.mark.realtime
@pytest.mark.parametrize("number", [float("nan"), float("inf")])
@pytest.mark.parametrize("part", ["linear", "angular"])
def test_twist_that_is_not_finite_is_not_sent(
    number: float, part: str, velocities: Any, requests: Any
) -> None:
    made, now_ns = requests[0], time.monotonic_ns()
    with pytest.raises(ValueError, match="finite"):
        made.on_velocity("cmd_vel", TWIST, memoryview(encode(TWIST, {part: {"x": number}})), now_ns, 1, 0)
    right = memoryview(encode(TWIST, {"linear": {"x": 1.0, "y": 0.5}, "angular": {"z": -0.2}}))
    made.on_velocity("cmd_vel", TWIST, right, now_ns, 2, 0)
    velocity = velocities.get(timeout=WAIT_S)
    assert (velocity["stamp_ns"], velocity["forward_mps"], velocity["right_mps"]) == (now_ns, 1.0, -0.5)
    assert velocity["turn_radps"] == 0.2


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("kind", "stamp_s", "late_s", "age_s", "used"),
    [
        (TWIST, 0, 0.0, 0.0, True),  # of a publisher without a clock
        (TWIST, 0, 0.0, 0.3, True),
        (TWIST, 0, 0.0, -7.0, True),  # its clock is ahead
        (TWIST, 0, 0.0, 0.6, False),
        (TWIST, 0, 0.6, 0.0, False),  # waited for us
        (TWIST_STAMPED, 0, 0.0, 0.0, True),
        (TWIST_STAMPED, 50, 0.0, 0.0, True),
        (TWIST_STAMPED, 49, 0.0, 0.0, False),
        (TWIST_STAMPED, 0, 0.0, 0.6, False),
    ],
)
def test_velocity_older_than_half_a_second_is_not_sent(
    kind: str, stamp_s: int, late_s: float, age_s: float, used: bool, velocities: Any, requests: Any
) -> None:
    linear = {"linear": {"x": 1.0}}
    stamped = {"header": {"stamp": {"sec": stamp_s}}, "twist": linear}
    payload = memoryview(encode(kind, stamped if kind == TWIST_STAMPED else linear))
    received_ns = time.monotonic_ns() - round(late_s * 1e9)
    arguments = "cmd_vel", kind, payload, received_ns, 50 * 10**9, round(age_s * 1e9)
    if used:
        requests[0].on_velocity(*arguments)
        assert velocities.get(timeout=WAIT_S)["forward_mps"] == 1.0
    else:
        with pytest.raises(ValueError, match="old"):
            requests[0].on_velocity(*arguments)


def wait_until(fits: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not fits():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def test_messages_of_one_frame_have_one_stamp() -> None:
    clock, stamp_ns = ServiceClock(), time.monotonic_ns()
    first = clock.ros_time_ns(stamp_ns)
    for later in range(100):
        clock.ros_time_ns(stamp_ns + later)
    assert {clock.ros_time_ns(stamp_ns) for _ in range(100)} == {first}
    clock.on_ros_time(stamp_ns, 5 * 10**9, True)
    assert clock.ros_time_ns(stamp_ns) == 5 * 10**9


def test_messages_of_a_frame_of_ros_have_the_stamp_of_its_image() -> None:
    clock, captured_ns = ServiceClock(), time.monotonic_ns()
    computed = clock.ros_time_ns(captured_ns)
    image_ns = computed + 123_457
    clock.on_frame(captured_ns, image_ns)
    assert clock.ros_time_ns(captured_ns) == image_ns
    for later in range(1, 2000):  # other stamps, as those of the vehicle
        clock.ros_time_ns(captured_ns + later)
    clock.on_ros_time(captured_ns, 5 * 10**9, True)
    clock.on_status(7 * 10**15)
    assert clock.ros_time_ns(captured_ns) == image_ns


def test_stamps_of_images_are_kept_for_the_newest_512() -> None:
    clock, captured_ns = ServiceClock(), time.monotonic_ns()
    for index in range(513):
        clock.on_frame(captured_ns + index, index)
    assert clock.ros_time_ns(captured_ns) != 0
    assert [clock.ros_time_ns(captured_ns + index) for index in range(1, 513)] == list(range(1, 513))
