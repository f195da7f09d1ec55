"""YAML as plain data: the core schema of YAML 1.2, without tags, anchors or duplicate keys.

`no`, `on` and `1:30` stay strings (YAML 1.1 converts them, and they are class names too). Input that would
expand to something large is rejected before it is built.
"""

from __future__ import annotations

import re
from typing import Any, ClassVar

import yaml

_LONGEST_TEXT = 2 << 20
_MOST_EVENTS = 100_000
_DEEPEST = 32
_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DumperBase: Any = yaml.SafeDumper


class PlainYamlError(ValueError):
    """Text that is not plain YAML; the message is one line with the problem and its line number."""


class _PlainLoader(_Base):  # type: ignore[misc]
    """The safe loader with the scalar types of YAML 1.2's core schema."""

    yaml_implicit_resolvers: ClassVar[dict[str, list[tuple[str, re.Pattern[str]]]]] = {}


class PlainDumper(_DumperBase):  # type: ignore[misc]
    """The matching safe dumper: quotes strings that this reader would parse as numbers (`1e5`)."""


def _resolve(tag: str, pattern: str, first: str) -> None:
    for side in (_PlainLoader, PlainDumper):
        side.add_implicit_resolver(f"tag:yaml.org,2002:{tag}", re.compile(pattern), list(first))


_resolve("null", r"^(?:~|null|Null|NULL|)$", "~nN")
_PlainLoader.yaml_implicit_resolvers.setdefault("", []).extend(_PlainLoader.yaml_implicit_resolvers["~"])
_resolve("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF")
# No octal, and no number long enough to be slow to parse.
_resolve("int", r"^[-+]?(?:0|[1-9][0-9]{0,17})$", "-+0123456789")
_EXPONENT = r"(?:[eE][-+]?[0-9]{1,3})"
_resolve(
    "float",
    rf"^[-+]?(?:\.[0-9]{{1,30}}|[0-9]{{1,30}}\.[0-9]{{0,30}}){_EXPONENT}?$|^[-+]?[0-9]{{1,30}}{_EXPONENT}$"
    r"|^[-+]?\.(?:inf|Inf|INF)$|^\.(?:nan|NaN|NAN)$",
    "-+0123456789.",
)


def _mapping(loader: Any, node: yaml.MappingNode) -> dict[Any, Any]:
    result: dict[Any, Any] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            raise PlainYamlError(f"line {line}: a key must be a plain value")
        key = loader.construct_object(key_node, deep=True)
        if key in result:
            raise PlainYamlError(f"line {line}: duplicate key {key!r:.100}")
        result[key] = loader.construct_object(value_node, deep=True)
    return result


_PlainLoader.add_constructor("tag:yaml.org,2002:map", _mapping)


def load_plain_yaml(text: str) -> Any:
    """Parse `text` to dicts, lists, strings, numbers, booleans, None.

    Raises:
        PlainYamlError: not YAML, or uses tags or anchors, or exceeds the limits (2 MiB, 100 000 values,
            32 levels).
    """
    if len(text) > _LONGEST_TEXT:
        raise PlainYamlError(f"has {len(text)} characters, the limit is {_LONGEST_TEXT}")
    try:
        _check_events(text)
        return yaml.load(text, Loader=_PlainLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}: " if mark is not None else ""
        raise PlainYamlError(f"{where}{error.problem or error.context or 'not YAML'}") from None
    except yaml.YAMLError as error:
        raise PlainYamlError(" ".join(str(error).split())) from None


def numbered(table: dict[Any, Any]) -> list[Any] | None:
    """`{0: person, 1: car}` → a list, also of texts for numbers; None if the keys are not 0, 1, …"""
    if sorted(map(str, table)) != sorted(map(str, range(len(table)))):
        return None
    return [table[index] if index in table else table[str(index)] for index in range(len(table))]


def _check_events(text: str) -> None:
    """Reject tags, anchors and oversized input before anything is built."""
    depth = 0
    for index, event in enumerate(yaml.parse(text, Loader=_PlainLoader)):
        if index > _MOST_EVENTS:
            raise PlainYamlError(f"has more than {_MOST_EVENTS} values, the limit of a description")
        assert event.start_mark is not None
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise PlainYamlError(f"line {line}: anchors and aliases (& and *) are not supported")
        tag = getattr(event, "tag", None)
        if tag is not None and tag != "!":
            raise PlainYamlError(f"line {line}: the tag {tag!r:.100} is not supported and was not run")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _DEEPEST:
                raise PlainYamlError(f"line {line}: nested more than {_DEEPEST} levels deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
