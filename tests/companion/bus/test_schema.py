"""The schemas and tables made of the topics."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, get_args

import pytest
from jsonschema import Draft202012Validator, ValidationError

from companion.bus.bodies.frames import (
    FrameBody,
    MarkerBody,
    ObjectBody,
    PositionBody,
    TrackEventBody,
)
from companion.bus.bodies.service import CommandReplyBody, EventBody
from companion.bus.schema import ALL_TOPICS, schema_of, topic_table, topics_markdown, write_schemas
from companion.guidance.formation.pose import Role
from companion.guidance.objects.target import RangeSource
from tests.companion.bus.message_check import check_message, closed, validator
from tests.companion.command_line import companion_here
from vision.detections import TRACK_CONFIRMED, TRACK_NONE, TRACK_TENTATIVE
from vision.tracking import TrackEventKind

MESSAGES = (Path(__file__).parents[3] / "docs" / "messages.md").read_text()


@pytest.mark.parametrize("topic", ALL_TOPICS, ids=lambda topic: topic.name)
def test_schema_is_valid_and_describes_every_field(topic: Any) -> None:
    schema = schema_of(topic.body)
    Draft202012Validator.check_schema(schema)
    for part in (schema, *schema.get("$defs", {}).values()):
        for field in part.get("properties", {}).values():
            assert field["description"]
            assert "title" not in field


def test_words_are_those_of_the_code() -> None:
    detection = validator("detections").schema["$defs"]["DetectionBody"]["properties"]
    event = validator("tracks").schema["$defs"]["TrackEventBody"]["properties"]
    assert detection["track_state"]["anyOf"][0]["enum"] == [TRACK_CONFIRMED, TRACK_TENTATIVE, TRACK_NONE]
    assert detection["range_source"]["anyOf"][0]["enum"] == [source.value for source in RangeSource]
    assert event["event"]["enum"] == [kind.value for kind in TrackEventKind]
    assert validator("pose").schema["properties"]["role"]["enum"] == list(get_args(Role))


def test_check_refuses_unknown_missing_and_wrong_fields() -> None:
    event: EventBody = {"stamp_ns": 1, "level": "info", "text": "ready"}
    check_message("events", event)
    for wrong in ({**event, "more": 1}, {"stamp_ns": 1, "level": "info"}, {**event, "level": "loud"}):
        with pytest.raises(ValidationError):
            check_message("events", wrong)


def test_mission_reply_has_steps() -> None:
    reply = Draft202012Validator(closed(schema_of(CommandReplyBody)))
    step = {"title": "find", "command": "seek", "success": True, "reason": "", "started_ns": 1, "ended_ns": 2}
    reply.validate({"command": "mission", "success": True, "reason": "", "steps": [step]})
    reply.validate({"command": "hold", "success": True, "reason": ""})
    assert not reply.is_valid({"command": "hold", "success": True})


def test_table_in_the_document_is_that_of_the_code() -> None:
    assert topics_markdown() in MESSAGES


def section(name: str) -> str:
    (found,) = re.findall(rf"^## {name}\n(.*?)^## ", MESSAGES, re.MULTILINE | re.DOTALL)
    return str(found)


def example(name: str) -> dict[str, Any]:
    """The example of a topic; that of tracks omits fields that the example of detections has."""
    (block,) = re.findall(r"^```json\n(.*?)^```", section(name), re.MULTILINE | re.DOTALL)
    body: dict[str, Any] = json.loads(block)
    if name == "tracks":
        frame = example("detections")
        (detection,) = frame["detections"]
        body = {**{key: frame[key] for key in [*FrameBody.__annotations__, "objects"]}, **body}
        for event in body["events"]:
            same = TrackEventBody.__annotations__.keys() & detection.keys()
            event |= {key: detection[key] for key in same | PositionBody.__annotations__.keys()}
    return body


@pytest.mark.parametrize("name", ["detections", "tracks", "pose", "velocity", "command_state"])
def test_example_body_in_the_document_is_valid(name: str) -> None:
    check_message(name, example(name))


@pytest.mark.parametrize(("name", "body"), [("objects", ObjectBody), ("markers", MarkerBody)])
def test_every_field_is_in_the_document(name: str, body: Any) -> None:
    (fields,) = re.findall(r": ((?:`\w+`,?\s?)+)\.", section(name))
    assert re.findall(r"\w+", fields) == [*body.__annotations__]


def test_schema_files(tmp_path: Path) -> None:
    written = write_schemas(tmp_path / "schemas")
    assert [path.name for path in written] == [f"{topic.name}.schema.json" for topic in ALL_TOPICS]
    schema = json.loads((tmp_path / "schemas" / "events.schema.json").read_text())
    assert schema["required"] == ["stamp_ns", "level", "text"]


def test_topics_on_the_command_line(tmp_path: Path) -> None:
    printed = companion_here("describe", "topics", "--json", cwd=tmp_path)
    assert [json.loads(line) for line in printed.stdout.splitlines()] == topic_table()
    assert companion_here("describe", "topics", "--markdown", cwd=tmp_path).stdout == topics_markdown()
    listed = companion_here("describe", "topics", "--schema", tmp_path / "schemas", cwd=tmp_path)
    assert len(listed.stdout.splitlines()) == len(ALL_TOPICS)
    plain = companion_here("describe", "topics", cwd=tmp_path).stdout
    assert all(topic.name in plain for topic in ALL_TOPICS)
