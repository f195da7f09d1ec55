"""The command `select`: its grammar, the camera it is for, and its reply."""

from __future__ import annotations

from companion.bench.lockstep_flight import plain_settings
from companion.guidance import Select
from companion.guidance.grammar import parse
from companion.perception.cameras import PerceptionCamera
from companion.service.command_handler import CommandHandler
from companion.service.inputs import InputAssembler
from companion.settings import Settings
from vision.tracking import Selected, SelectRequest


class AnsweringCamera(PerceptionCamera):
    """A camera that answers a selection with a track."""

    def __init__(self, settings: Settings, name: str | None) -> None:
        super().__init__(settings, name)
        self.requests: list[SelectRequest] = []

    async def select(self, request: SelectRequest) -> Selected:
        self.requests.append(request)
        return Selected(True, "track 7, a target", 7, "target")


class Cameras:
    """Two cameras, `down` beside the first, which steers."""

    def __init__(self) -> None:
        settings = plain_settings({"cameras.down.source.uri": "none"})
        self.first, self.down = AnsweringCamera(settings, None), AnsweringCamera(settings, "down")
        self.events: list[tuple[str, str]] = []
        inputs = InputAssembler(settings, [self.first, self.down], lambda *event: self.events.append(event))

        def read(_identifier: int, text: str) -> Select:
            command = parse(text)
            assert isinstance(command, Select)
            return command

        self.handler = CommandHandler(
            read,
            inputs.select,
            lambda: None,
            lambda *event: self.events.append(event),
            check_requirements=lambda _: "flies nothing",
            on_state=lambda _: None,
            service="service1",
        )


def test_rectangle_of_a_command() -> None:
    command = parse("select camera=front x=0.40 y=0.30 width=0.10 height=0.20 stamp_ns=91000000")
    assert command == Select(0.4, 0.3, 0.1, 0.2, "front", 91e6)
    assert parse(str(command)) == command
    assert isinstance(command, Select)
    assert command.request == SelectRequest((0.4, 0.3, 0.1, 0.2), 91_000_000)
    assert Select().request == SelectRequest(None)


async def test_reply_has_track_and_class_and_nothing_is_flown() -> None:
    cameras = Cameras()
    reply = await cameras.handler.execute("select x=0.4 y=0.3 width=0.1 height=0.2")
    assert reply == {
        "id": "service1-1",
        "state": "ended",
        "command": "select x=0.4 y=0.3 width=0.1 height=0.2",
        "success": True,
        "reason": "track 7, a target",
        "track": 7,
        "class": "target",
    }
    assert cameras.first.requests == [SelectRequest((0.4, 0.3, 0.1, 0.2))]
    assert cameras.handler.take_commands() == ()


async def test_camera_is_named_or_the_steering_one() -> None:
    cameras = Cameras()
    reply = await cameras.handler.execute("select x=0.4 y=0.3 width=0.1 height=0.2 camera=down")
    assert reply["track"] == 7
    assert "not of the " in reply["reason"]
    assert len(cameras.down.requests) == 1
    assert not cameras.first.requests
    await cameras.handler.execute("select camera=first")
    assert cameras.first.requests == [SelectRequest(None)]
    reply = await cameras.handler.execute("select camera=nose")
    assert not reply["success"]
    assert reply["track"] is None
    assert "camera 'nose'; " in reply["reason"]
    assert ": first, down" in reply["reason"]
