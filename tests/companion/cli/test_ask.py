"""`companion ask` at a real bus over loopback: confirmation, stop, colours by the image, bad input."""

from __future__ import annotations

import asyncio
import io
import json
import os
import socket
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion import connect
from companion.bench.lockstep_flight import plain_settings
from companion.bus import topics
from companion.bus.session import Bus
from companion.cli import app
from companion.cli.ask import Terminal, _converse
from companion.guidance.grammar import json_schema
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port

CLASSES = ("person", "car")
BOXES = {3: (20.0, 40.0, 120.0, 100.0), 5: (180.0, 40.0, 280.0, 100.0)}
RED_CAR = "circle the red car"
QUESTION = "what do you see?"


class Service:
    """The bus of a service that sees a red and a blue car. `goto` and `orbit` fly until `stop`."""

    def __init__(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.commands: list[str] = []
        self.ready = True
        self.frame: dict[str, Any] | None = {"model": "yolov8n"}  # None: the camera is dead
        self.perception = {"state": "running", "model": "yolov8n", "problem": ""}
        self.vehicle: dict[str, Any] = {"yaw_rad": 1.5, "altitude_m": 5.0, "mode": "hold", "armed": True}
        self.vehicle["position_ned_m"] = [1.0, 2.0, -5.0]
        self.flying, self.stopped = asyncio.Event(), asyncio.Event()
        self.bus = Bus(
            ZenohSection(listen=(self.endpoint,)),
            "vehicle",
            on_event=lambda *_: None,
            on_command=self._execute,
            queries={"commands": self._schema, "config": self._config},
        )

    async def _schema(self) -> Any:
        return json_schema(CLASSES if self.ready else None)

    async def _config(self) -> Any:
        return {"guidance": {"camera": None}, "detector": {"enabled": True}}

    async def _execute(self, text: str) -> dict[str, Any]:
        self.commands.append(text)
        if text == "stop":
            self.stopped.set()
        if text.startswith(("goto", "orbit")):
            self.flying.set()
            await self.stopped.wait()
        return {"command": text, "success": True, "reason": f"{text.split()[0]}: ended"}

    async def publish(self) -> None:
        """What the service sends, ten times a second."""
        image = np.full((120, 160, 3), (60, 140, 80), np.uint8)  # half the frame's size
        image[15:55, 5:65], image[15:55, 85:145] = (30, 25, 200), (200, 80, 30)
        jpeg = cv2.imencode(".jpg", image)[1].tobytes()
        for sequence in range(10_000):
            common = {"class_name": "car", "object_id": 1, "bearing_rad": 1.4, "ground_range_m": 11.0}
            objects = [{**common, "track_id": track, "xyxy": box} for track, box in BOXES.items()]
            # Not where this frame's detection is: 9 m away at 1.6 rad.
            there = {"object_id": 1, "position_ned_m": [0.737, 10.996, 0.0]}
            if self.frame is not None:
                frame = {"sequence": sequence, "width": 320, "height": 240, "objects": [there]}
                self.bus.publish(topics.DETECTIONS, frame | {"detections": objects} | self.frame)
            self.bus.publish(topics.STATUS, {"perception": self.perception})
            self.bus.publish(topics.VEHICLE, self.vehicle)
            self.bus.publish_large(
                topics.IMAGE,
                jpeg,
                {"camera": None, "sequence": sequence, "captured_ns": 0, "annotated": False},
            )
            await asyncio.sleep(0.05)


@asynccontextmanager
async def service() -> AsyncIterator[Service]:
    opened = Service()
    await opened.bus.start()
    publishing = asyncio.create_task(opened.publish())
    try:
        yield opened
    finally:
        publishing.cancel()
        await opened.bus.close()


async def ask(there: Service, sentence: str | None, **changes: str) -> bool:
    settings = plain_settings(
        {"vehicle.name": "vehicle", "zenoh.connect": there.endpoint}
        | {key.replace("__", "."): value for key, value in changes.items()}
    )
    return await _converse(settings, None, sentence)


@contextmanager
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[TextIO]:
    """Standard input as a pipe; what is written to it is typed."""
    reading, writing = os.pipe()
    with os.fdopen(reading) as standard_input, os.fdopen(writing, "w", buffering=1) as typed:
        monkeypatch.setattr(sys, "stdin", standard_input)
        yield typed
        typed.close()


async def shown(text: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Wait until a text is printed; everything printed until then."""
    printed = ""
    async with asyncio.timeout(20):
        while text not in printed:
            printed += capsys.readouterr().out
            await asyncio.sleep(0.01)
    return printed


@pytest.mark.parametrize(("answer", "commands"), [("y", ["orbit radius=10 track=3"]), ("n", [])])
async def test_red_car_is_flown_to_if_confirmed(
    answer: str, commands: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with keyboard(monkeypatch) as typed:
        async with service() as there:
            there.stopped.set()
            asked = asyncio.create_task(ask(there, "find the red car and circle it at ten metres"))
            assert "orbit radius=10 track=3\n" in await shown("fly this?", capsys)
            typed.write(f"{answer}\n")
            assert await asyncio.wait_for(asked, 20) is bool(commands)
            assert there.commands == commands


@pytest.mark.parametrize("ahead", ["", "y\n"])  # an answer before the question confirms nothing
async def test_nothing_is_flown_without_somebody_to_confirm(
    ahead: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(ahead))
    async with service() as there:
        assert not await ask(there, RED_CAR)
    assert there.commands == []
    assert "language.may" in capsys.readouterr().out


async def test_stop_is_sent_while_the_vehicle_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    with keyboard(monkeypatch) as typed:
        async with service() as there:
            chat = asyncio.create_task(ask(there, None, language__may="orbit"))
            typed.write("circle track 3\n")
            await asyncio.wait_for(there.flying.wait(), 20)
            typed.write("what do you see\nSTOP!\nquit\n")
            assert await asyncio.wait_for(chat, 20) is True
            assert there.commands[:2] == ["orbit track=3", "stop"]


@pytest.mark.parametrize("sentence", ["stop the drone", None])
async def test_stop_does_not_wait_for_the_detector(
    sentence: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with keyboard(monkeypatch) as typed:
        async with service() as there:
            there.ready = False
            typed.write("circle track 3\nstop\nquit\n")
            assert await asyncio.wait_for(ask(there, sentence, language__may="orbit"), 5) is True
            assert there.commands == ["stop"]


async def test_a_running_sentence_sends_nothing_after_the_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its command is superseded by the stop before the stop is answered; its next command is not flown."""

    class Two:
        def __init__(self, drone: Any) -> None:
            self.drone = drone

        async def ask(self, _: str) -> bool:
            await self.drone.command("orbit track=3")
            await self.drone.command("takeoff")
            return True

    with keyboard(monkeypatch) as typed:
        async with service() as there, connect(there.endpoint) as drone:

            async def begin() -> Any:
                return Two(drone)

            async def stop() -> bool:
                await drone.command("stop")
                await asyncio.sleep(0.3)
                return True

            chat = asyncio.create_task(Terminal().attend(begin, stop, None))
            typed.write("circle track 3, then take off\n")
            await asyncio.wait_for(there.flying.wait(), 20)
            typed.write("stop\nquit\n")
            assert await asyncio.wait_for(chat, 20) is True
    assert set(there.commands) == {"orbit track=3", "stop"}


async def test_what_is_seen_has_colour_range_and_direction(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    async with service() as there:
        assert await ask(there, QUESTION)
    where = "9 m away 6 deg to the right"
    assert f"red car (track 3) {where}; blue car (track 5) {where}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("frame", "perception", "words"),
    [
        ({"model": "yolov8n", "detections": []}, {}, ("seen: no object",)),
        (
            None,
            {"state": "failed", "problem": "source lost"},
            ("no detections received", "failed", "source lost"),
        ),
        ({"model": None, "detections": []}, {"model": None}, ("no detections received", "no detector")),
    ],
)
async def test_dead_camera_is_not_a_free_view(
    frame: dict[str, Any] | None,
    perception: dict[str, Any],
    words: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    monkeypatch.setattr("companion.language.live._STATE_S", 1.0)
    async with service() as there:
        there.frame = frame
        there.perception |= perception
        answered = await ask(there, QUESTION)
        free = words[0] == "seen: no object"
        assert answered is free
    printed = capsys.readouterr().out
    assert all(word in printed for word in words)
    assert ("no object" in printed) is free


async def test_zenoh_questions_are_answered_and_fly_what_is_allowed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    async with service() as there:
        changes = {"zenoh.connect": there.endpoint, "language.may": "takeoff,orbit"}
        settings = plain_settings({"vehicle.name": "vehicle"} | changes)
        serving = asyncio.create_task(_converse(settings, None, None, serve=True))
        await shown("answering companion/vehicle/ask", capsys)
        async with connect(there.endpoint) as drone:

            async def question(text: str) -> dict[str, Any]:
                def get() -> dict[str, Any]:
                    until_s = time.monotonic() + 20.0
                    while time.monotonic() < until_s:  # until the queryable is known here
                        for reply in drone.session.get("companion/vehicle/ask", payload=text, timeout=20):
                            if reply.ok is not None:
                                answer: dict[str, Any] = json.loads(reply.ok.payload.to_string())
                                return answer
                        time.sleep(0.05)
                    raise TimeoutError

                return await asyncio.to_thread(get)

            seen = await question("where is the car?")
            assert seen["success"] is True
            assert "red car (track 3)" in seen["answer"]
            assert (await question("land"))["success"] is False
            unclear = await question("follow the car")
            assert unclear["answer"].startswith("which car")
            assert there.commands == []
            flying = asyncio.create_task(question("circle the red car"))
            await asyncio.wait_for(there.flying.wait(), 20)
            assert (await question("take off"))["answer"].startswith("busy")
            assert await question("stop") == {"success": True, "answer": "stop"}
            ended = await flying
            assert ended["success"] is False
            assert ended["answer"].endswith("by stop")
            assert "at most 2000" in (await question("take off" + " " * 2000))["answer"]
            assert set(there.commands) == {"orbit track=3", "stop"}
            assert (await question("take off"))["success"] is True
        assert there.commands[-1] == "takeoff"
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--language-may", "fly"), "language.may"),
        (("--language-url", "localhost"), "language.url"),
        (("--language-model", "small", "--language-key-file", "missing"), "language.key_file"),
        ((), "companion run"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    flags: tuple[str, ...], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    result = CliRunner().invoke(app, ["ask", "take off", "--connect", endpoint, *flags])
    assert result.exit_code == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert words in result.stderr


def test_control_characters_do_not_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = Terminal()
    terminal.write("\x1b[2Jred\x07 car")
    terminal.show("\x1b]0;title\x07done")
    assert capsys.readouterr().out == "?[2Jred? car\n?]0;title?done\n"


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from companion.language.endpoints import LanguageError, endpoint_of

    monkeypatch.setitem(sys.modules, "httpx", None)
    with pytest.raises(LanguageError, match=r"\[language\]"):
        endpoint_of("http://127.0.0.1:11434", "small")
