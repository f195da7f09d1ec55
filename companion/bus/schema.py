"""JSON Schema of every message, and the table of topics as text, JSON and Markdown."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import zenoh
from pydantic import TypeAdapter, ValidationError
from pydantic.json_schema import GenerateJsonSchema
from typing_extensions import get_original_bases

from companion.bus.bodies import frames, service, vehicle
from companion.bus.topics import INPUT_TOPICS, TOPICS, Topic
from companion.host.peer_data import PeerDataError, parse_object
from companion.settings.section import texts_below_keys

DIALECT = GenerateJsonSchema.schema_dialect
ALL_TOPICS = (*TOPICS, *INPUT_TOPICS)
_MODULES = (frames, vehicle, service)


class _WithoutTitles(GenerateJsonSchema):
    """A title in every field would repeat its name."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def schema_of(body: Any) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a body's type. Unknown fields are allowed: they are added."""
    schema = TypeAdapter(body).json_schema(schema_generator=_WithoutTitles)
    for name, part in {**schema.get("$defs", {}), schema.get("title", ""): schema}.items():
        for key, text in _texts_of(name).items():
            part["properties"][key]["description"] = text
    return {"$schema": DIALECT, **schema}


@cache
def _adapter(body: Any) -> TypeAdapter[Any]:
    return TypeAdapter(body)


def read_body(topic: Topic, data: bytes) -> dict[str, Any]:
    """Return the body of a message, or of its attachment, whose size was checked; unknown fields stay.

    Raises:
        PeerDataError: it is not what the topic says.
    """
    value = parse_object(data)
    try:
        _adapter(topic.body).validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise PeerDataError(f"{topic.name}: {where}: {first['msg']}") from None
    return value


def _texts_of(name: str) -> dict[str, str]:
    """Return field → the string below it, of a body and its bases."""
    texts = {owner: below for m in _MODULES for owner, below in texts_below_keys(m.__name__).items()}
    if name not in texts:
        return {}
    body = next(getattr(module, name) for module in _MODULES if hasattr(module, name))
    bases = [base.__name__ for base in get_original_bases(body)]
    return {key: text for owner in (*bases, name) for key, text in texts.get(owner, {}).items()}


def topic_table() -> list[dict[str, Any]]:
    """Return the topics as plain values: name, encoding, rate, maximum age and contents."""
    return [
        {
            "name": topic.name,
            "payload": payload_of(topic),
            "encoding": str(topic.encoding),
            "published": topic.published,
            "rate_hz": topic.rate_hz,
            "max_age_s": topic.max_age_s,
            "of_camera": topic.of_camera,
            "cached": topic.cached,
            "description": topic.description,
        }
        for topic in ALL_TOPICS
    ]


def payload_of(topic: Topic) -> str:
    """Return the kind of payload, in one word."""
    if topic.encoding == zenoh.Encoding.IMAGE_JPEG:
        return "JPEG"
    if topic.encoding == zenoh.Encoding.APPLICATION_OCTET_STREAM:
        return "binary"
    return "text" if topic.encoding == zenoh.Encoding.TEXT_PLAIN else "JSON"


def _contents(topic: Topic) -> str:
    kind = payload_of(topic)
    return topic.description if kind == "JSON" else f"{kind}: {topic.description}"


def _max_age_and_kept(topic: Topic) -> str:
    age = [] if topic.max_age_s is None else [f"{topic.max_age_s:g} s"]
    return "; ".join(age + [f"newest {topic.cached}"] * bool(topic.cached))


COLUMNS = ("name", "payload, JSON unless stated", "published", "max age; kept")


def topic_rows() -> list[tuple[str, ...]]:
    """Return the rows of the table for people, with `COLUMNS`."""
    return [
        (
            topic.name,
            _contents(topic),
            topic.published,
            _max_age_and_kept(topic),
        )
        for topic in ALL_TOPICS
    ]


def topics_markdown() -> str:
    """Return the table in docs/messages.md."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    lines += ["| " + " | ".join((f"`{name}`", *rest)) + " |" for name, *rest in topic_rows()]
    return "\n".join(lines) + "\n"


def write_schemas(folder: Path) -> list[Path]:
    """Write NAME.schema.json for every topic. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for topic in ALL_TOPICS:
        path = folder / f"{topic.name}.schema.json"
        path.write_text(json.dumps(schema_of(topic.body), indent=2, ensure_ascii=False) + "\n")
        written.append(path)
    return written
