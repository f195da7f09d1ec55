"""Validates published messages against the JSON Schema of their topic, unknown fields included."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

from jsonschema import Draft202012Validator

from companion.bus.schema import ALL_TOPICS, schema_of


def closed(schema: dict[str, Any]) -> dict[str, Any]:
    """The schema with fields that it does not name forbidden."""
    for part in (schema, *schema.get("$defs", {}).values()):
        if "properties" in part:
            part["additionalProperties"] = False
    return schema


@cache
def validator(name: str) -> Draft202012Validator:
    (topic,) = (topic for topic in ALL_TOPICS if topic.name == name)
    return Draft202012Validator(closed(schema_of(topic.body)))


def check_message(name: str, body: Any) -> None:
    """Raise ValidationError for a body that is not of this topic; through strict JSON."""
    validator(name).validate(json.loads(json.dumps(body, allow_nan=False)))
