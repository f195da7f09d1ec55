"""The asyncio client at real buses over loopback: commands, cancellation, messages, steering, its imports."""

from __future__ import annotations

import asyncio
import inspect
import json
import math
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from companion import connect
from companion.bus import topics
from companion.bus.listeners import Listener
from companion.bus.session import Bus
from companion.client import CommandFailedError, Drone, NoAnswerError, Stream
from companion.client.commands import Commands, Reply
from companion.guidance.command import COMMANDS, arguments_of, value_of
from companion.guidance.grammar import parse
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tools import client_commands

IMPORT_S = 0.3
TAKEN_OVER = "the pilot took over"


class Vehicle:
    """The bus of a service. A command `hold …` waits for `stop`; those in `refused` fail; others succeed.

    Attributes:
        commands: texts in the order of arrival. velocities: messages on `velocity`.
    """

    def __init__(self, name: str = "alpha", router: str | None = None) -> None:
        self.name, self.endpoint = name, f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.commands: list[str] = []
        self.velocities: list[dict[str, Any]] = []
        self.refused = {"land"}
        self._stopped = asyncio.Event()
        settings = ZenohSection(listen=(self.endpoint,))
        if router is not None:
            settings = ZenohSection(mode="client", connect=(router,), listen=())
        self.bus = Bus(
            settings,
            name,
            on_event=lambda *_: None,
            on_command=self._execute,
            listeners=[
                Listener(topics.VELOCITY, lambda data, _ns: self.velocities.append(json.loads(data)), name)
            ],
        )

    async def _execute(self, text: str) -> dict[str, Any]:
        self.commands.append(text)
        if text == "stop":
            self._stopped.set()
        if text.startswith(("hold", "gimbal")):
            self._stopped.clear()
            await self._stopped.wait()
            return {"command": text, "success": False, "reason": "replaced by stop"}
        success = text.split()[0] not in self.refused
        return {"id": f"a-{len(self.commands)}", "command": text, "success": success, "reason": "refused 7"}

    def end(self, number: int, reason: str) -> None:
        """Publish the end of a command."""
        body = {"id": f"a-{number}", "command": "c", "state": "ended", "success": False, "reason": reason}
        self.bus.publish(topics.COMMAND_STATE, body)


@asynccontextmanager
async def vehicle(name: str = "alpha", router: str | None = None) -> AsyncIterator[Vehicle]:
    opened = Vehicle(name, router)
    await opened.bus.start()
    try:
        yield opened
    finally:
        await opened.bus.close()


@asynccontextmanager
async def connected() -> AsyncIterator[tuple[Vehicle, Drone]]:
    async with vehicle() as there, connect(there.endpoint) as drone:
        yield there, drone


async def until(condition: Any) -> None:
    async with asyncio.timeout(20.0):
        while not condition():
            await asyncio.sleep(0.01)


async def watched(there: Vehicle, topic: topics.Topic) -> None:
    await until(lambda: there.bus.watched(topic))


def test_import_loads_nothing_heavy_and_is_fast() -> None:
    text = (
        "import sys, time; begun = time.process_time(); from companion import connect; connect;"
        "print(time.process_time() - begun);"
        "print(*{'torch', 'cv2', 'numpy', 'onnxruntime', 'vision.frame', 'pymavlink'} & set(sys.modules))"
    )
    runs = [
        subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert min(float(run.splitlines()[0]) for run in runs) < IMPORT_S
    assert [run.splitlines()[1] for run in runs] == ["", ""]


def test_methods_are_those_of_the_command_table() -> None:
    written = Path(client_commands.FILE).read_text()
    assert written == client_commands.source(), "run: python -m tools.client_commands"


class Written(Commands):
    async def command(self, text: str) -> Reply:
        return {"command": text}


@pytest.mark.parametrize("kind", COMMANDS.values(), ids=lambda kind: kind.word)
async def test_texts_of_methods_are_valid_commands(kind: Any) -> None:
    method = getattr(Written(), kind.word.replace("-", "_"))
    needed: dict[str, Any] = {
        "goto": {"north": 1.5, "east": -2e-7},
        "follow-path": {"points": "0,0 10,0,5"},
        "seek": {"class_": "traffic light"},
        "approach": {"track": 7},
        "follow": {"class_": 'a "quoted\\ name'},
        "patrol": {"points": "0,0 1,1 2,0", "classes": "person,car"},
        "mission": {"file": "my mission.toml"},
        "policy": {"file": "my policy.onnx", "class_": "car"},
        "formation": {"shape": "wedge", "leader": "beta"},
        "land-on-marker": {"id": 7},
        "velocity": {"source": "a-1"},
        "select": {"x": 0.1, "y": 0.2, "width": 0.3, "height": 0.4, "stamp_ns": 91000000},
    }
    arguments = needed.get(kind.word, {})
    assert set(arguments) <= set(inspect.signature(method).parameters)
    command = parse((await method(**arguments))["command"])
    assert type(command) is kind
    values = {key.removesuffix("_"): value for key, value in arguments.items()}
    given = {argument.key: value_of(command, part) for part, argument in arguments_of(kind)}
    assert {key: given[key] for key in values} == values


@pytest.mark.realtime
async def test_command_returns_its_reply_or_raises() -> None:
    async with connected() as (there, drone):
        assert drone.name == "alpha"
        assert (await drone.takeoff(5))["success"]
        with pytest.raises(CommandFailedError, match="refused 7") as failed:
            await drone.land()
    assert failed.value.reply["success"] is False
    assert there.commands == ["takeoff altitude=5", "land"]


@pytest.mark.realtime
@pytest.mark.parametrize("moment", ["active", "not sent yet"])
async def test_cancelled_command_is_stopped(moment: str) -> None:
    async with connected() as (there, drone):
        task = asyncio.create_task(drone.hold(duration=60))
        if moment == "active":
            await until(lambda: there.commands)
        else:
            await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert there.commands[-1] == "stop"
        assert ("hold duration=60" in there.commands) or moment == "not sent yet"


class Scripted(Drone):
    """`stop` succeeds at once; other commands are answered by the test. `outcomes`: by their texts."""

    def __init__(self, session: Any = None) -> None:
        super().__init__(session, "alpha")
        self.sent: list[str] = []
        self.outcomes: dict[str, asyncio.Future[Reply]] = {}

    def _send(self, text: str, timeout_s: float) -> asyncio.Future[Reply]:
        self.sent.append(text)
        self.outcomes[text] = asyncio.get_running_loop().create_future()
        if text == "stop":
            self.outcomes[text].set_result({"command": text, "success": True, "reason": "holding"})
        return self.outcomes[text]


@pytest.mark.parametrize(("success", "sent"), [(True, ["hold", "stop"]), (False, ["hold"])])
async def test_command_answered_in_the_moment_of_its_cancellation(success: bool, sent: list[str]) -> None:
    drone = Scripted()
    task = asyncio.create_task(drone.hold())
    await asyncio.sleep(0)
    drone.outcomes["hold"].set_result({"command": "hold", "success": success, "reason": "in progress"})
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert drone.sent == sent


async def test_empty_command_can_be_cancelled() -> None:
    drone = Scripted()
    task = asyncio.create_task(drone.command(" "))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert drone.sent == [" "]


@pytest.mark.realtime
async def test_timeout_stops_a_flight_but_not_for_the_gimbal() -> None:
    async with connected() as (there, drone):
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.5):
                await drone.gimbal(pitch=-30)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.5):
                await drone.hold()
    assert there.commands == ["gimbal pitch=-30", "hold", "stop"]


@pytest.mark.realtime
@pytest.mark.parametrize("size", [1, 3])
async def test_slow_reader_gets_the_newest_messages(size: int) -> None:
    async with connected() as (there, drone):
        stream = drone.vehicle(size=size)
        assert stream.age_s == math.inf
        await watched(there, topics.VEHICLE)
        for number in range(50):  # one by one: the bus drops what comes too fast
            there.bus.publish(topics.VEHICLE, {"number": number})
            await until(lambda arrived=number + 1: stream.dropped == max(arrived - size, 0))
        got = [(await anext(stream))["number"] for _ in range(size)]  # type: ignore[typeddict-item]
        assert got == list(range(50 - size, 50))
        assert 0.0 <= stream.age_s < 5.0


class ScriptedSession:
    """A session with one subscriber, called by the test."""

    def declare_subscriber(self, key: str, put: Callable[[Any], None]) -> Any:
        self.put = put
        return SimpleNamespace(undeclare=lambda: None)

    def receive(self, number: int) -> None:
        data = json.dumps({"number": number}).encode()
        self.put(SimpleNamespace(payload=zenoh.ZBytes(data)))


@pytest.mark.parametrize(("waited_s", "first"), [(0.4, 1), (0.6, 2)])
async def test_message_that_waited_too_long_is_dropped(
    waited_s: float, first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, session = 100.0, ScriptedSession()
    monkeypatch.setattr("companion.client.stream.time", SimpleNamespace(monotonic=lambda: now_s))
    stream: Stream[Any] = Drone(session, "alpha").vehicle(size=2)  # type: ignore[arg-type]
    session.receive(1)
    now_s += waited_s  # topics.VEHICLE.max_age_s is 0.5
    session.receive(2)
    assert (await asyncio.wait_for(anext(stream), 10.0))["number"] == first
    assert stream.dropped == first - 1


@pytest.mark.realtime
async def test_kept_events_come_first_and_deleted_stream_unsubscribes() -> None:
    async with connected() as (there, drone):
        there.bus.publish(topics.EVENTS, {"stamp_ns": 1, "level": "info", "text": "before"})
        stream: Stream[Any] = drone.events()
        assert (await asyncio.wait_for(anext(stream), 10.0))["text"] == "before"
        frames = drone.detections()
        await watched(there, topics.DETECTIONS)
        del frames
        await until(lambda: not there.bus.watched(topics.DETECTIONS))


@pytest.mark.realtime
async def test_images_are_bytes() -> None:
    async with connected() as (there, drone):
        images = drone.image()
        await watched(there, topics.IMAGE)
        there.bus.publish_large(topics.IMAGE, b"\xff\xd8", {})  # type: ignore[arg-type]
        assert await asyncio.wait_for(anext(images), 10.0) == b"\xff\xd8"


@pytest.mark.realtime
async def test_steering_sends_velocities_and_ends_with_zero() -> None:
    async with connected() as (there, drone):
        async with drone.steer() as steering:
            steering.send(forward=1.0, turn=-0.5, lifetime=0.3)
            with pytest.raises(ValueError, match="forward"):
                steering.send(forward=float("nan"))
            with pytest.raises(ValueError, match="lifetime"):
                steering.send(lifetime=0.6)
        await until(lambda: len(there.velocities) == 2)
    first, last = there.velocities
    assert there.commands == [f'velocity source="{steering.source}"']
    assert (first["source"], first["forward_mps"], first["turn_radps"]) == (steering.source, 1.0, -0.5)
    assert {last[key] for key in ("forward_mps", "right_mps", "up_mps", "turn_radps")} == {0.0}


@pytest.mark.realtime
async def test_steering_raises_once_something_else_is_flown() -> None:
    async with connected() as (there, drone):
        async with drone.steer() as steering:
            steering.send(forward=1.0)
            there.end(1, "replaced by orbit")
            with pytest.raises(CommandFailedError, match="replaced by orbit") as failed:
                await until(lambda: steering.send(forward=2.0))
            assert failed.value.reply["id"] == "a-1"
        # The last velocity is not flown on by the next steering: zero replaces it.
        await until(lambda: there.velocities[-1]["forward_mps"] == 0.0)
        assert there.velocities[0]["forward_mps"] == 1.0


@pytest.mark.realtime
@pytest.mark.parametrize("late", [False, True])
async def test_end_of_an_endless_command_has_its_reason(late: bool) -> None:
    """Also one that comes before it is waited for, with more messages after it than are kept."""
    async with connected() as (there, drone):
        reply, other = await drone.takeoff(3), await drone.takeoff(4)
        if not late:
            waiting = asyncio.create_task(drone.ended(reply))
            await asyncio.sleep(0)
        there.end(1, TAKEN_OVER)
        for number in range(3, 3 + topics.COMMAND_STATE.cached if late else 3):
            there.end(number, "refused")
            await asyncio.sleep(0.002)
        there.end(2, "replaced by hold")
        assert (await asyncio.wait_for(drone.ended(other), 20.0))["reason"] == "replaced by hold"
        ended = await asyncio.wait_for(drone.ended(reply) if late else waiting, 20.0)
        assert (ended["id"], ended["reason"]) == ("a-1", TAKEN_OVER)


@pytest.mark.realtime
async def test_waiting_for_an_end_fails_with_the_service() -> None:
    async with connected() as (there, drone):
        there.bus.publish(topics.STATUS, {"vehicle": {"without_service": "PX4 holds its position"}})
        reply = await drone.takeoff(3)
        waiting = [asyncio.create_task(drone.ended(reply)) for _ in range(2)]
        await anext(drone.status())
        await there.bus.close()
        for task in waiting:
            with pytest.raises(NoAnswerError, match=r"has gone .*PX4"):
                await asyncio.wait_for(task, 20.0)
        with pytest.raises(NoAnswerError):
            await asyncio.wait_for(drone.ended(reply), 20.0)


@pytest.mark.realtime
async def test_silent_service_is_reported_while_an_end_is_awaited(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("companion.client.endings.SILENT_S", 0.2)
    async with connected() as (there, drone):
        there.bus.publish(topics.STATUS, {"vehicle": {"without_service": "PX4 holds its position"}})
        reply = await drone.takeoff(3)
        waiting = asyncio.create_task(drone.ended(reply))
        await until(lambda: caplog.records)
        assert not waiting.done()
        there.end(1, TAKEN_OVER)  # it has only been slow
        assert (await asyncio.wait_for(waiting, 20.0))["reason"] == TAKEN_OVER
    (record,) = caplog.records
    assert (record.levelname, record.name) == ("WARNING", "companion.client.endings")
    assert "PX4" in record.getMessage()


@pytest.mark.realtime
async def test_refused_steering_sends_nothing_and_source_stays() -> None:
    async with connected() as (there, drone):
        there.refused = {"velocity"}
        with pytest.raises(CommandFailedError):
            async with drone.steer():
                pass
        there.refused = set()
        async with drone.steer() as steering:
            with pytest.raises(RuntimeError, match=r"alpha .*`steer\(\)`"):
                async with drone.steer():
                    pass
        async with drone.steer() as again:  # the last message of the steering before is still valid
            assert again.source == steering.source
        await until(lambda: len(there.velocities) == 2)
    assert {one["source"] for one in there.velocities} == {steering.source}


@pytest.mark.realtime
async def test_several_vehicles_on_one_connection() -> None:
    async with vehicle() as first, vehicle("beta", router=first.endpoint) as second:
        async with connect(first.endpoint, "beta") as beta:
            await until(lambda: second.bus.connected)
            assert await beta.vehicles() == ["alpha", "beta"]
            await asyncio.gather(beta.takeoff(3), beta.other("alpha").takeoff(4))
        with pytest.raises(ValueError, match="alpha, beta"):
            async with connect(first.endpoint):
                pass
    assert (first.commands, second.commands) == (["takeoff altitude=4"], ["takeoff altitude=3"])


@pytest.mark.realtime
async def test_connection_without_a_service_is_an_error() -> None:
    with pytest.raises(NoAnswerError, match="tcp/127"):
        async with connect(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"):
            pass
    with pytest.raises(NoAnswerError, match="endpoint"):
        async with connect("nowhere"):
            pass


@pytest.mark.realtime
async def test_service_that_ends_fails_a_waiting_command() -> None:
    async with connected() as (there, drone):
        task = asyncio.create_task(drone.hold())
        await until(lambda: there.commands)
        await there.bus.close()
        with pytest.raises((NoAnswerError, CommandFailedError)):
            await asyncio.wait_for(task, 20.0)


@pytest.mark.realtime
async def test_bad_messages_of_others_are_dropped_and_counted() -> None:
    async with connected() as (there, drone):
        stream = drone.vehicle(size=10)
        await watched(there, topics.VEHICLE)
        huge = b" " * (topics.VEHICLE.largest_bytes + 1)
        for data in (b"", b"[]", b"\xff", b'{"a": NaN}', b"[" * 10_000, huge):
            there.bus.publish(topics.VEHICLE, data)
        there.bus.publish(topics.VEHICLE, {"altitude_m": 5.0})
        async with asyncio.timeout(20.0):
            assert (await anext(stream))["altitude_m"] == 5.0
        await until(lambda: stream.dropped == 6)
