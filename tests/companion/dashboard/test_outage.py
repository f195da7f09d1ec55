"""What the page says when the service or the way to it is gone: its own function, run in node."""

from __future__ import annotations

from typing import Any

import pytest

from tests.companion.dashboard.page_module import NODE, evaluate

pytestmark = pytest.mark.skipif(NODE is None, reason="no node on the PATH")

SILENCE = {"text": "without setpoints PX4 holds its position after 1.1 s"}
KNOWN = {
    "silentS": 0.1,
    "problem": "",
    "alive": True,
    "oldS": 1.0,
    "status": {"vehicle": {"silence": SILENCE}, "pilot": {"behaviour": "orbiting"}},
    "vehicle": {"armed": True, "mode": "offboard"},
}
GONE = {"alive": False, "oldS": 7.0}


def said(**changed: Any) -> dict[str, str] | None:
    value: dict[str, str] | None = evaluate("outage.js", "module.outage(given)", KNOWN | changed)
    return value


def test_nothing_is_said_while_the_service_answers() -> None:
    assert said() is None
    assert said(alive=None, oldS=3.9) is None
    assert said(alive=False, oldS=None, status=None, vehicle=None) is None


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
    ("vehicle", "words", "absent"),
    [
        ({"armed": True, "mode": "offboard"}, ("stopped", "holds its position"), ()),
        ({"armed": True, "mode": "hold"}, ("hold mode",), ("setpoints",)),
        ({"armed": True, "mode": "precision_land"}, ("precision land mode",), ("setpoints",)),
        ({"armed": False, "mode": "offboard"}, ("disarmed",), ("setpoints",)),
        (None, ("mode",), ("setpoints",)),
    ],
)
def test_what_the_vehicle_does_follows_from_its_last_mode(
    vehicle: dict[str, Any] | None, words: tuple[str, ...], absent: tuple[str, ...]
) -> None:
    lines = said(**GONE, vehicle=vehicle)
    assert lines is not None
    assert [word for word in words if word not in lines["vehicle"]] == []
    assert [word for word in absent if word in lines["vehicle"]] == []


def test_lost_connection_is_not_taken_for_a_lost_service() -> None:
    lines = said(problem="connection lost")
    assert lines is not None
    assert "if its service still runs" in lines["vehicle"]
    assert "orbiting" in lines["vehicle"]
    assert SILENCE["text"] in lines["vehicle"]


def test_outage_without_a_vehicle_or_its_failsafe_says_so() -> None:
    lines = said(**GONE, status={"parts": [{"name": "camera"}]})
    assert lines is not None
    assert "no vehicle" in lines["vehicle"]
    lines = said(**GONE, status={"vehicle": {}})
    assert lines is not None
    assert "not known" in lines["vehicle"]
