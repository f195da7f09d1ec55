"""The functions that a language model may call: the command table and the questions, as JSON Schema."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from companion.guidance.command import COMMANDS, Command, GrammarError, known_class
from companion.guidance.grammar import parse
from companion.language.clauses import QUESTIONS, Question
from vision.class_names import near_names

MAX_CALLS = 50
_QUESTION_HELP = {
    "seen": "the objects in the camera's newest image: class, track, colour, range and bearing from the nose",
    "battery": "the battery's charge, percent",
    "state": "flight mode, whether armed, height, position and the active command",
    "why_not": "why the newest command was refused or ended, and the newest warnings",
}
# Before, between and after calls that are written as text.
_MARKUP = re.compile(r"(?:[\s,;]|```\w*|</?\w+>|<\|\w+\|>|\[TOOL_CALLS\])*")
_CALL_KEYS = frozenset({"name", "arguments", "parameters", "type", "id"})
_THOUGHT = re.compile(r"\A\s*<think>.*?</think>", re.DOTALL)
# What they fly is not in the call, so nobody could confirm it.
_NOT_FOR_MODELS = frozenset({"mission", "policy", "velocity"})


@dataclass(frozen=True, slots=True)
class ToolCall:
    """A call as the model wrote it: nothing is checked. `identifier`: of OpenAI's format, else empty."""

    name: str
    arguments: Any
    identifier: str = ""


def tools_of(schema: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The tools in the format that Ollama and OpenAI share, short, since a small computer reads them slowly.

    The detector's classes stand in `seek` only: a list of eighty names is 300 tokens.

    Args:
        schema: what the queryable `commands` answers (`grammar.json_schema`).
    """
    tools = []
    classes = class_names_of(schema)
    for word, command in schema["$defs"].items():
        if word in _NOT_FOR_MODELS:
            continue
        described = command["description"]
        if exclusive := [key for each in command.get("oneOf", ()) for key in each["required"]]:
            described += f". Give exactly one of {', '.join(exclusive)}"
        repeated = None if word == "seek" else classes
        properties = {key: _property(value, repeated) for key, value in command["properties"].items()}
        tools.append(_tool(word, described, properties, command["required"]))
    seen = {"class": {"type": "string", "description": "only this class"}}
    for name in QUESTIONS:
        tools.append(_tool(name, _QUESTION_HELP[name], seen if name == "seen" else {}, []))
    return tools


def check_words(name: str, words: Sequence[str], *, for_models: bool = False) -> None:
    """Check a list of commands. `name`: of the setting or flag, for errors.

    Raises:
        ValueError: a command does not exist, or is not for models.
    """
    for word in words:
        if word not in COMMANDS:
            raise ValueError(f"{name}: unknown command {word!r}; {near_names(word, list(COMMANDS))}")
        if for_models and word in _NOT_FOR_MODELS:
            raise ValueError(f"{name}: {word} is not for a model: the call does not show the command")


def class_names_of(schema: Mapping[str, Any]) -> tuple[str, ...] | None:
    """The detector's classes in the schema of the commands; None: not known."""
    names = schema["$defs"].get("seek", {}).get("properties", {}).get("class", {}).get("enum")
    return None if names is None else tuple(map(str, names))


def arguments_of(value: Any) -> Any:
    """The arguments of a call as a server sends them: an object, its JSON text (also twice), or none.

    What is neither is returned as it is, for `read_call` to refuse; so is a text with a key given twice.
    """
    for _ in range(2):
        if not isinstance(value, str):
            break
        if not value.strip():
            return {}
        try:
            value = json.loads(value, object_pairs_hook=_unique)
        except (ValueError, RecursionError):
            return value
    return {} if value is None else value


def calls_of(value: Any) -> tuple[ToolCall, ...]:
    """The calls of a message's `tool_calls`. Raises ValueError: they have no names."""
    each = [] if value is None else value if isinstance(value, list) else [value]
    return tuple(_call_of(one) for one in each)


def calls_in(text: str, offered: Collection[str]) -> tuple[ToolCall, ...]:
    """The calls that a small model writes as text instead of calling.

    Args:
        text: of at most `MAX_CALLS` calls: JSON objects of `name` and `arguments` (Llama 3: `parameters`), or
            with these in `function`, also in code fences or tags, after a <think> block. Any other word makes
            it an answer, and there are no calls. So does another key, a name that is no text or arguments
            that are no object (null: none).
        offered: names of the tools, which are calls without arguments too.

    Returns:
        The calls, without identifiers.
    """
    text = _THOUGHT.sub("", text)
    if "<think>" in text:  # without an end
        return ()
    calls, end = list[ToolCall](), 0
    try:
        while (begin := _end_of_markup(text, end)) < len(text):
            value, end = json.JSONDecoder(object_pairs_hook=_unique).raw_decode(text, begin)
            for each in value if isinstance(value, list) else [value]:
                inner, call = each.get("function", each), replace(_call_of(each), identifier="")
                known = _CALL_KEYS if inner is each else {"function", "type", "id"}
                if not (each.keys() <= known and inner.keys() <= _CALL_KEYS):
                    return ()
                if not isinstance(call.arguments, dict) or (call.name not in offered and len(inner) < 2):
                    return ()
                calls.append(call)
    except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
        return ()
    return tuple(calls) if len(calls) <= MAX_CALLS else ()


def _call_of(value: Any) -> ToolCall:
    """A call of an object. Raises ValueError: it has no name, or two kinds of arguments."""
    if not isinstance(value, dict):
        raise ValueError("no call")
    function = value.get("function", value)
    given = [function[key] for key in ("arguments", "parameters") if key in function]
    if (
        not isinstance(function.get("name"), str)
        or len(given) > 1
        or value.get("type", "function") != "function"
    ):
        raise ValueError("no call")
    return ToolCall(function["name"], arguments_of(*given or (None,)), str(value.get("id") or ""))


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(found := dict(pairs)) < len(pairs):
        raise ValueError("a key is given twice")
    return found


def _end_of_markup(text: str, begin: int) -> int:
    found = _MARKUP.match(text, begin)
    return begin if found is None else found.end()


def read_call(call: ToolCall, class_names: Sequence[str] | None) -> Command | Question:
    """Check a call by the grammar.

    Raises:
        GrammarError: an unknown tool or argument, a wrong type, a value out of its range.
    """
    if not isinstance(call.name, str):
        raise GrammarError(f"unknown tool {str(call.name)[:80]!r}")
    arguments = arguments_of(call.arguments)
    if not isinstance(arguments, Mapping):
        raise GrammarError(f"{call.name}: the arguments must be an object, got {str(call.arguments)[:80]!r}")
    given = {key: value for key, value in arguments.items() if value is not None}
    if call.name in QUESTIONS:
        about = given.get("class", "")
        if not about or not isinstance(about, str):
            return Question(call.name)
        return Question(call.name, (about if class_names is None else known_class(about, class_names),))
    if call.name not in COMMANDS:
        known = [word for word in COMMANDS if word not in _NOT_FOR_MODELS]
        raise GrammarError(f"unknown command {call.name[:80]!r}; {near_names(call.name[:80], known)}")
    _check_offered(call.name)
    command = parse(
        " ".join([call.name, *(_written(call.name, *item) for item in given.items())]), class_names
    )
    _check_offered(command.word)
    return command


def _check_offered(word: str) -> None:
    if word in _NOT_FOR_MODELS:
        raise GrammarError(f"{word} is not for a model: the call does not show the command")


def _written(name: str, key: Any, value: Any) -> str:
    if not isinstance(key, str) or not key.replace("_", "").isalpha() or not key.isascii():
        raise GrammarError(f"{name}: unknown argument {str(key)[:40]!r}")
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise GrammarError(f"{name}: {key} must be a number or a text, got {str(value)[:40]!r}")
    text = value if isinstance(value, str) else repr(value)
    return f'{key}="' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _property(schema: Mapping[str, Any], repeated: Sequence[str] | None) -> dict[str, Any]:
    """Without keys that are not JSON Schema's; the unit goes into the description.

    Args:
        repeated: class names that are not listed again.
    """
    described = {
        key: _short(value) for key, value in schema.items() if not (key == "default" and value == "")
    }
    if unit := described.pop("unit", None):
        described["description"] += f", {unit}"
    if repeated is not None and tuple(described.get("enum", ())) == tuple(repeated):
        del described["enum"]
        described["description"] += "; classes as in seek"
    return described


def _short(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _tool(name: str, description: str, properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    parameters = {"type": "object", "properties": properties} | ({"required": required} if required else {})
    return {
        "type": "function",
        "function": {"name": name, "description": description, "parameters": parameters},
    }
