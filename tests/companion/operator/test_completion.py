"""What TAB offers, and the help: from the schema of the commands."""

from __future__ import annotations

import pytest

from companion.guidance.grammar import json_schema
from companion.operator.completion import completions, help_lines

SCHEMA = json_schema(("person", "traffic light", "car"))
KEYS = ("guidance.max_altitude_m", "guidance.min_altitude_m", "detector.classes")


def offered(line: str, *recent: str, vehicles: tuple[str, ...] = ()) -> list[str]:
    begin, found = completions(line, SCHEMA, keys=KEYS, recent=recent, vehicles=vehicles)
    assert all(word.startswith(line[begin:]) for word in found)
    return found


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("tak", ["takeoff"]),
        ("  tak", ["takeoff"]),
        ("stat", ["status"]),
        ("land", ["land-on-marker"]),
        ("takeoff ", ["altitude="]),
        ("takeoff altitude=3 ", []),
        ("seek tr", ["traffic_light"]),
        ("seek class=p", ["class=person"]),
        ("orbit car dir", ["direction="]),
        ("orbit car direction=c", ["direction=counterclockwise", "direction=clockwise"]),
        ("help rt", ["rtl"]),
        ("set guidance.max", ["guidance.max_altitude_m="]),
        ("set detector.classes=person,tr", ["detector.classes=person,traffic_light"]),
        ("nothing ", []),
    ],
)
def test_words_that_fit_are_offered(line: str, words: list[str]) -> None:
    assert sorted(offered(line)) == sorted(words)


def test_first_argument_is_offered_once() -> None:
    assert {"car", "person", "distance="} <= set(offered("approach "))
    assert not {"car", "class=", "distance="} & set(offered("approach car distance=3 "))


def test_words_typed_before_are_offered_for_their_command() -> None:
    assert offered("formation leader=", "formation line leader=hawk", "goto 1 2") == ["leader=hawk"]
    assert offered("mission survey", "vehicle2 mission survey.toml") == ["survey.toml"]


def test_vehicle_may_stand_first() -> None:
    assert offered("veh", vehicles=("vehicle1", "vehicle2")) == ["vehicle1", "vehicle2"]
    assert offered("vehicle2 tak", vehicles=("vehicle1", "vehicle2")) == ["takeoff"]
    assert offered("vehicle2 veh", vehicles=("vehicle1", "vehicle2")) == []


def test_without_a_schema_the_console_words_remain() -> None:
    assert completions("st", {}, keys=(), recent=()) == (0, ["status"])


def test_help_has_every_command_and_every_argument() -> None:
    words = {line.split()[0] for line in help_lines(SCHEMA)}
    assert set(SCHEMA["$defs"]) | {"set", "status", "help", "quit"} <= words
    _, *arguments = help_lines(SCHEMA, "approach")
    assert [line.split()[0] for line in arguments] == list(SCHEMA["$defs"]["approach"]["properties"])
    with pytest.raises(ValueError, match="nothing"):
        help_lines(SCHEMA, "nothing")
