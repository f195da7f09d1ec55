"""What ROS requests of the vehicle: velocities, an object to seek, commands."""

from __future__ import annotations

import json
import math
import re
import secrets
import time
from collections import Counter
from collections.abc import Callable
from threading import Lock, Thread
from typing import Any

import zenoh

from companion.bus.client import NoAnswerError, send_command
from companion.bus.command_order import CommandOrder, Turn, is_stop
from companion.bus.topics import VELOCITY
from companion.host.peer_data import PeerDataError
from companion.ros2.cdr import decode, encode
from companion.ros2.gateway import NodeTopic

STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
_OLDEST_NS = 500_000_000  # of a velocity, as on the bus
_CLASS_NAME = re.compile(r'[^"\\\x00-\x1f]{1,64}')
_JUST_STARTED_NS, _REPETITION_NS = 5_000_000_000, 10_000_000_000
_AGAIN = "the same text within 10 s is no new command; publish it --once"
_REPEATED = "the same text again is no new request; publish an empty one before it"
_SHOWN = 200  # characters of a command in its outcome
# A mission takes up to an hour.
_TIMEOUT_S, _STOP_TIMEOUT_S = 3600.0, 10.0
# A newer command ends the one before, so more than a few do not wait for their outcome at once. `stop` has a
# separate allowance of the same size.
_MOST_COMMANDS = 16
_DISABLED = "ros2.commands is false: the settings must allow commands from ROS"


def _mission(wanted: str) -> str:
    steps = (json.dumps(f'{word} "{wanted}"', ensure_ascii=False) for word in ("seek", "approach"))
    return "mission object_to_seek\n" + "".join(f"[[step]]\ndo = {step}\n" for step in steps)


class Requests:
    """Passes on what the node receives. Its functions are called in the node's thread, and return at once.

    Args:
        commands: whether commands are executed. Velocities are passed on in any case: the service uses them
            only under its command `velocity`.
        publish_result: called with each outcome, as CDR of a String with JSON, from any thread.
        say: called with a line.
    """

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str,
        *,
        commands: bool,
        publish_result: Callable[[bytes], None],
        say: Callable[[str], None],
    ) -> None:
        self._session, self._vehicle, self._commands = session, vehicle, commands
        self._publish_result, self._say = publish_result, say
        self._source = f"ros2-{secrets.token_hex(4)}"
        say(f"cmd_vel: steers under the command: velocity source={self._source}")
        self._velocities = session.declare_publisher(
            VELOCITY.key(vehicle),
            encoding=VELOCITY.encoding,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=VELOCITY.priority,
            express=VELOCITY.express,
        )
        self._lock, self._order = Lock(), CommandOrder()
        self._running: Counter[bool] = Counter()  # that wait for their outcome, by whether it is `stop`
        self._object: str | None = None  # the newest that was received
        self._started_ns = time.monotonic_ns()
        self._command, self._command_ns = "", 0  # the newest that was received, and when

    def topics(self) -> tuple[NodeTopic, ...]:
        """Return what a node subscribes to, and the topic of the outcomes."""
        return (
            NodeTopic("~/result", STRING),
            NodeTopic("cmd_vel", TWIST, self.on_velocity, reliable=False, depth=1, other_type=TWIST_STAMPED),
            NodeTopic("object_to_seek", STRING, self.on_object),
            NodeTopic("~/command", STRING, self.on_command),
        )

    def on_velocity(
        self, name: str, type_name: str, payload: memoryview, received_ns: int, ros_now_ns: int, age_ns: int
    ) -> None:
        """Process a Twist or TwistStamped: metres and radians per second, FLU.

        One that waited in a program that stood still, or in the network, must not steer.

        Raises:
            ValueError: it is not used.
        """
        message = decode(type_name, payload)
        twist = message.get("twist", message)
        linear, angular = twist["linear"], twist["angular"]
        stamp = message["header"]["stamp"] if type_name == TWIST_STAMPED else {"sec": 0, "nanosec": 0}
        if (stamp_ns := stamp["sec"] * 1_000_000_000 + stamp["nanosec"]) != 0:
            age_ns = max(age_ns, ros_now_ns - stamp_ns)
        age_ns += time.monotonic_ns() - received_ns
        if age_ns > _OLDEST_NS:
            raise ValueError(
                f"is {age_ns / 1e9:.1f} s old: do both computers have the same time? (use_sim_time)"
            )
        if not all(map(math.isfinite, (*linear.values(), *angular.values()))):
            raise ValueError("a velocity is not a finite number")
        body = {
            "source": self._source,
            "stamp_ns": received_ns,
            "forward_mps": linear["x"],
            "right_mps": -linear["y"],
            "up_mps": linear["z"],
            "turn_radps": -angular["z"],
        }
        self._velocities.put(json.dumps(body))

    def on_object(self, name: str, type_name: str, payload: memoryview, received_ns: int, *_: int) -> None:
        """Process the name of a class: `seek` it, then `approach` it, as one mission, which the pilot ends.

        A publisher may repeat it without end, also after the pilot or another command has ended the flight,
        or after a gap of the network. So the same text again is no new request, nor is the first one just
        after the start, which may be a repetition. An empty text ends the repetition.
        """
        wanted = str(decode(type_name, payload)["data"]).strip()
        with self._lock:
            before, self._object = self._object, wanted
            idle = self._running.total() == 0
        if not wanted:
            return
        first = before is None and received_ns - self._started_ns < _JUST_STARTED_NS
        if not _CLASS_NAME.fullmatch(wanted):
            self._answer(wanted, {"success": False, "reason": f"{name}: expected the name of a class"})
        elif not self._commands or (not first and wanted != before):
            self._start(_mission(wanted), wanted)
        elif idle:
            self._answer(wanted, {"success": False, "reason": f"{name}: {_REPEATED}"})

    def on_command(self, name: str, type_name: str, payload: memoryview, received_ns: int, *_: int) -> None:
        """Process a command of the grammar.

        `ros2 topic pub` repeats a message at 1 Hz unless it is given `--once`. So the same text less than
        10 s after it was received last is no new request, except `stop`.
        """
        text = str(decode(type_name, payload)["data"])
        with self._lock:
            again = text == self._command and received_ns - self._command_ns < _REPETITION_NS
            self._command, self._command_ns = text, received_ns
            idle = self._running.total() == 0
        if not again or is_stop(text) or not self._commands:
            self._start(text, text)
        elif idle:
            self._answer(text, {"success": False, "reason": f"{name}: {_AGAIN}"})

    def _start(self, command: str, text: str) -> None:
        """Send a command from a thread of its own; its outcome is published as that of `text`."""
        stop = is_stop(command)
        with self._lock:
            refused = _DISABLED if not self._commands else ""
            if self._running[stop] >= _MOST_COMMANDS:
                refused = f"{_MOST_COMMANDS} commands wait for their outcome"
            if not refused:
                self._running[stop] += 1
        if refused:
            self._answer(text, {"success": False, "reason": refused})
            return
        turn = self._order.turn(self._vehicle, command)

        def run() -> None:
            try:
                self._execute(command, text, turn)
            finally:
                with self._lock:
                    self._running[stop] -= 1

        Thread(target=run, name="ROS command", daemon=True).start()

    def _execute(self, command: str, text: str, turn: Turn) -> None:
        """Send a command, and publish its outcome as that of `text`."""
        timeout_s = _STOP_TIMEOUT_S if turn.is_stop else _TIMEOUT_S
        try:
            reply = send_command(
                self._session, self._vehicle, command, timeout_s=timeout_s, on_silent=self._say, turn=turn
            )
        except (NoAnswerError, PeerDataError, zenoh.ZError) as error:
            reply = {"success": False, "reason": str(error)}
        self._answer(text, reply)

    def _answer(self, text: str, reply: dict[str, Any]) -> None:
        self._publish_result(encode(STRING, {"data": json.dumps({"command": text[:_SHOWN], **reply})}))
