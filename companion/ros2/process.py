"""The node as a process: finds the Python of ROS, starts the node, starts it again, and talks with it."""

from __future__ import annotations

import asyncio
import json
import os
import posixpath
import shutil
import socket
import subprocess
import sys
from asyncio.subprocess import PIPE, STDOUT, Process
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Event, RLock, Thread
from typing import Any

import zenoh

from companion.bus.child_client import open_patiently
from companion.bus.client import client_settings
from companion.bus.topics import LARGEST_BINARY_BYTES, client_key
from companion.host.child_process import supervised
from companion.ros2 import node as protocol
from companion.ros2.gateway import Losses, NodeTopic, ServiceClock
from companion.ros2.images import ros_cameras
from companion.ros2.messages import OUTPUT_TOPICS, topic_name
from companion.ros2.wiring import connected, namespace_of
from companion.settings import Settings

# A node without a sign of life for so long is killed, and started again.
SILENT_S = 10.0
_PROBE_S = 30.0
# One that was killed is listed by the others for up to 20 s (the lease of DDS).
NAMESAKE_S = 25.0
_CLIENT = "ros2-node"
_END_S, _ENDS_ITSELF_S = 5.0, 1.0
_OF_NODE = ("name", "reliable", "latched", "depth", "adapts", "largest_bytes")


class Ros2Error(RuntimeError):
    """There is no ROS 2 here, or the node cannot be created. The message is one line."""


def find_python(chosen: str | None) -> str:
    """Return a Python that imports rclpy: the chosen one, else that of the sourced ROS.

    Raises:
        Ros2Error: there is none; it names what to source.
    """
    named = [chosen] if chosen else [shutil.which("python3"), "/usr/bin/python3", sys.executable]
    tried = list(dict.fromkeys(python for python in named if python))
    last = ""
    for python in tried:
        try:
            done = subprocess.run(
                [python, "-c", "import rclpy"], capture_output=True, text=True, timeout=_PROBE_S, check=False
            )
        except OSError as error:
            last = str(error.strerror)
            continue
        except subprocess.TimeoutExpired:
            last = f"not ready within {_PROBE_S:g} s"
            continue
        if done.returncode == 0:
            return python
        reasons = [line.partition(": ")[2] for line in done.stderr.splitlines() if "Error: " in line]
        last = reasons[0] if reasons else f"exit code {done.returncode}"
    setup = next(iter(sorted(map(str, Path("/opt/ros").glob("*/setup.bash")))), "/opt/ros/jazzy/setup.bash")
    advice = "--python names another one" if "AMENT_PREFIX_PATH" in os.environ else f"first: source {setup}"
    raise Ros2Error(f"no Python with rclpy (tried {', '.join(tried)}: {last}): {advice}")


def node_command(python: str, name: str, namespace: str, arguments: Sequence[str] = ()) -> list[str]:
    """Return the command of the node's process. `arguments`: for rclpy, from `--ros-args` on."""
    options = {"name": name, "namespace": f"/{namespace}", "namesake_s": NAMESAKE_S}
    return [python, protocol.__file__, json.dumps(options), *arguments]


def _described(topic: NodeTopic, channel: int) -> dict[str, Any]:
    """Return what the node reads of a topic."""
    about = {name: getattr(topic, name) for name in _OF_NODE}
    return {**about, "channel": channel, "types": _types(topic), "publish": topic.on_serialized is None}


def _types(topic: NodeTopic) -> list[str]:
    return [topic.type_name, *([] if topic.other_type is None else [topic.other_type])]


class RosNode:
    """The node, for the gateway. It outlives its process, which may be started again.

    Args:
        command, environment: of the process. The functions are called in a thread that reads its frames.
        on_ready: with the node's full name and its namespace, at each start.
        on_clock: with CLOCK_MONOTONIC, ROS time, nanoseconds, and whether the latter is simulated.
        say: with a line.
    """

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        *,
        on_ready: Callable[[str, str], None],
        on_clock: Callable[[int, int, bool], None],
        say: Callable[[str], None],
    ) -> None:
        self._command, self._environment = command, environment
        self._on_ready, self._on_clock, self._say = on_ready, on_clock, say
        self._topics: list[NodeTopic] = []  # the index is the channel
        self._channels: dict[str, int] = {}
        self._wanted: set[int] = set()
        self._socket: socket.socket | None = None
        self._lock, self._losses = RLock(), Losses(say)

    async def start(self) -> tuple[Process, Callable[[], None]]:
        """Start the process, for `supervised`."""
        ours, theirs = socket.socketpair()
        with theirs:
            process = await asyncio.create_subprocess_exec(
                *self._command,
                stdin=theirs.fileno(),
                stdout=PIPE,
                stderr=STDOUT,
                env=self._environment,
                process_group=0,  # Ctrl-C is for the parent
            )
        ours.settimeout(SILENT_S)
        with self._lock:
            self._socket = ours
            self._send_topics(0)
        loop, ended = asyncio.get_running_loop(), False

        def kill() -> None:
            with suppress(ProcessLookupError):
                process.kill()

        def read() -> None:
            self._read(ours)
            if not ended:  # it is stuck, or ends now: then a signal could take its exit code from the watcher
                loop.call_soon_threadsafe(loop.call_later, _ENDS_ITSELF_S, kill)

        def end() -> None:
            nonlocal ended
            ended = True
            _shut(ours)
            reading.join(_END_S)  # functions of zenoh may be at work in it

        reading = Thread(target=read, name="ROS node", daemon=True)
        reading.start()
        return process, end

    def declare(self, *topics: NodeTopic) -> None:
        """Publish topics, or subscribe to them. One that is declared already stays as it is."""
        with self._lock:
            first = len(self._topics)
            for topic in topics:
                if self._channels.setdefault(topic.name, len(self._topics)) == len(self._topics):
                    self._topics.append(topic)
            self._send_topics(first)

    def send(self, name: str, payload: bytes) -> None:
        """Publish CDR on a declared topic. Without a process it is dropped."""
        self._send(protocol.MESSAGE, self._channels[name], payload)

    def _send_topics(self, first: int) -> None:
        described = [_described(topic, first + index) for index, topic in enumerate(self._topics[first:])]
        self._send(protocol.TOPICS, 0, json.dumps(described).encode())

    def _send(self, kind: int, channel: int, body: bytes) -> None:
        with self._lock:
            if self._socket is None:
                return
            try:
                self._socket.sendall(protocol.FRAME.pack(kind, channel, len(body)))
                self._socket.sendall(body)
            except OSError:  # it has gone or is stuck: a frame may be sent in part
                _shut(self._socket)

    def _read(self, ours: socket.socket) -> None:
        """Process the frames of a process until its end."""
        body, header = memoryview(bytearray(1024)), memoryview(bytearray(protocol.FRAME.size))
        try:
            with ours, ours.makefile("rb") as stream:
                while stream.readinto(header) == len(header):
                    kind, channel, size = protocol.FRAME.unpack(header)
                    if size > len(body):  # one buffer for all: an image of 900 kB is copied once
                        body = memoryview(bytearray(size))
                    if stream.readinto(body[:size]) != size:
                        break
                    self._on_frame(kind, channel, body[:size])
        except TimeoutError:
            self._say(f"node: no sign of life for {SILENT_S:g} s; killed")
        except OSError:
            pass
        with self._lock:
            if self._socket is not ours:
                return  # the next process is there already
            self._socket = None
        for channel in tuple(self._wanted):
            self._set_wanted(channel, False)

    def _on_frame(self, kind: int, channel: int, body: memoryview) -> None:
        if kind == protocol.MESSAGE:
            topic, (kind, *stamps) = self._topics[channel], protocol.RECEIVED.unpack_from(body)
            assert topic.on_serialized is not None
            try:
                topic.on_serialized(topic.name, _types(topic)[kind], body[protocol.RECEIVED.size :], *stamps)
            except Exception as error:  # no message may end the thread
                self._losses.add(topic.name, f"{topic.name}: message left out: {error}")
        elif kind == protocol.WANTED:
            self._set_wanted(channel, bool(body[0]))
        elif kind == protocol.CLOCK:
            self._on_clock(*protocol.CLOCK_BODY.unpack(body))
        elif kind == protocol.READY:
            about = json.loads(bytes(body))
            self._on_ready(about["name"], about["namespace"].strip("/"))

    def _set_wanted(self, channel: int, wanted: bool) -> None:
        (self._wanted.add if wanted else self._wanted.discard)(channel)
        if (on_wanted := self._topics[channel].on_wanted) is not None:
            on_wanted(wanted)


def _shut(connection: socket.socket) -> None:
    with suppress(OSError):  # it is already
        connection.shutdown(socket.SHUT_RDWR)


def _published(settings: Settings) -> set[str]:
    """Full names of what a node publishes of the bus, where no argument of ROS renames it."""
    namespace = namespace_of(settings)
    names = (topic_name(topic, camera) for camera in (None, *settings.cameras) for topic in OUTPUT_TOPICS)
    return {posixpath.join("/", namespace, name) for name in names}


async def run_node(
    settings: Settings, python: str, arguments: Sequence[str], ending: Event, say: Callable[[str], None]
) -> None:
    """Run the node of a vehicle until `ending` is set. It waits for the service, however late it comes.

    Raises:
        Ros2Error: ROS refuses the node, for example its name; a source is a topic of the node itself.
        SourceError: a wrong `ros://` address.
    """
    ros2, clock, is_connected, refused = settings.ros2, ServiceClock(), False, ""
    token: zenoh.LivelinessToken | None = None
    uris = [uri for source in settings.sources().values() for uri in (source.uri, source.depth) if uri]
    cameras = ros_cameras(uris, say, clock.on_frame)
    images = {topic: kind for camera in cameras for topic, kind in camera.topics.items()}
    for topic in sorted(images.keys() & _published(settings)):
        raise Ros2Error(
            f"{topic} is no source: this node publishes it; set ros2.namespace, or rename the other"
        )
    with ExitStack() as stack:
        opening = open_patiently(client_settings(settings.zenoh), ending, say)
        if (session := await asyncio.to_thread(stack.enter_context, opening)) is None:
            return

        def on_ready(name: str, namespace: str) -> None:
            nonlocal is_connected, token
            token = session.liveliness().declare_token(client_key(settings.vehicle.name, _CLIENT))
            if not is_connected:  # a remap may have changed the namespace of the settings
                stack.enter_context(connected(session, settings, namespace, clock, [node], say))
                is_connected = True
            say(f"node: up: {name}")

        def on_end(why: str, again: bool) -> None:
            nonlocal refused, token
            token = None  # undeclares it
            if not again:
                refused = why
                ending.set()

        def on_image(*message: Any) -> None:
            for camera in cameras:
                camera.on_serialized(*message)

        environment = os.environ | ({} if ros2.domain_id is None else {"ROS_DOMAIN_ID": str(ros2.domain_id)})
        node = RosNode(
            node_command(python, ros2.node_name, namespace_of(settings), arguments),
            environment,
            on_ready=on_ready,
            on_clock=clock.on_ros_time,
            say=say,
        )
        node.declare(
            *(
                NodeTopic(
                    *(topic, kind, on_image),
                    reliable=False,
                    depth=2,
                    adapts=True,
                    largest_bytes=LARGEST_BINARY_BYTES,
                )
                for topic, kind in images.items()
            )
        )
        for camera in cameras:
            stack.callback(camera.close)
        async with supervised("node", node.start, say, on_end=on_end):
            await asyncio.to_thread(ending.wait)
    if refused:
        raise Ros2Error(refused)
