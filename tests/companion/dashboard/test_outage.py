"""What the page says when the service or the way to it is gone: its own function, run in node."""

from __future__ import annotations

from typing import Any

import pytest

from tests.companion.dashboard.page_module import evaluate

pytestmark = pytest.mark.needs("node")

SILENCE = "without setpoints PX4 holds its position after 1.1 s"
KNOWN = {
    "silentS": 0.1,
    "problem": "",
    "alive": True,
    "oldS": 1.0,
    "status": {
        "vehicle": {"without_service": SILENCE},
        "pilot": {"behaviour": "orbiting", "in_command": True},
    },
}
GONE = {"alive": False, "oldS": 7.0}


def said(**changed: Any) -> dict[str, str] | None:
    value: dict[str, str] | None = evaluate("outage.js", "module.outage(given)", KNOWN | changed)
    return value


def test_nothing_is_said_while_the_service_answers() -> None:
    assert said() is None
    assert said(alive=None, oldS=3.9) is None
    assert said(alive=False, oldS=None, status=None) is None


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        (GONE, "gone"),
        ({"oldS": 5.0}, "silent"),
        ({"silentS": 9.0, "oldS": 10.0}, "dashboard"),
        ({"problem": "no zenoh node"}, "no zenoh node"),
    ],
)
def test_outage_says_what_happened_and_how_old_it_is(changed: dict[str, Any], word: str) -> None:
    lines = said(**changed)
    assert lines is not None
    assert word in lines["what"]
    assert f"{changed.get('oldS', 1.0):.0f} s" in lines["what"]
    assert "remote control" in lines["todo"]


@pytest.mark.parametrize(
    ("in_command", "sentence"), [(True, SILENCE), (False, "the vehicle was disarmed"), (False, None)]
)
def test_outage_has_the_sentence_of_the_last_status(in_command: bool, sentence: str | None) -> None:
    vehicle = {} if sentence is None else {"without_service": sentence}
    lines = said(**GONE, status={"vehicle": vehicle, "pilot": {"in_command": in_command}})
    assert lines is not None
    assert (sentence or "not known")[1:] in lines["vehicle"]
    assert ("have stopped" in lines["vehicle"]) == in_command


def test_lost_connection_is_not_taken_for_a_lost_service() -> None:
    lines = said(problem="connection lost")
    assert lines is not None
    assert "its service" in lines["vehicle"]
    assert "orbiting" in lines["vehicle"]
    assert SILENCE in lines["vehicle"]
