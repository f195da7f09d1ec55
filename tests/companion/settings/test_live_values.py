"""The settings that can be changed while the service runs, and when."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.settings import Settings
from companion.settings.live import (
    LIMITS,
    NARROWER,
    describe_live,
    live_value_of_text,
    live_values,
    with_live_values,
)
from companion.settings.reading import ConfigurationError, changed

TWO = Settings.model_validate({"cameras": {"down": {"source": {"uri": "none"}}}})
FILE = live_values(TWO)
LIMIT_KEYS = [key for key, narrower in NARROWER.items() if narrower]


def is_wider(key: str, value: float, than: float) -> bool:
    return value > than if NARROWER[key] == "smaller" else value < than


def scaled(key: str, *, wider: bool) -> float:
    """A value that is wider or narrower than the file's."""
    larger = wider == (NARROWER[key] == "smaller")
    return float(FILE[key]) * (1.5 if larger else 0.5)


@pytest.mark.parametrize("disarmed", [True, False], ids=["disarmed", "armed or unknown"])
@pytest.mark.parametrize("wider", [True, False], ids=["wider", "narrower"])
@pytest.mark.parametrize("key", LIMIT_KEYS)
def test_limit_is_made_wider_only_while_disarmed(key: str, wider: bool, disarmed: bool) -> None:
    value = scaled(key, wider=wider)
    if wider and not disarmed:
        with pytest.raises(ConfigurationError, match=key):
            with_live_values(TWO, {key: value}, disarmed=disarmed)
    else:
        now = live_values(with_live_values(TWO, {key: value}, disarmed=disarmed))
        assert now == FILE | {key: value}


@pytest.mark.parametrize("prefix", ["", "cameras.down."])
@pytest.mark.parametrize("confidence", [0.1, 0.9])
def test_detector_is_changed_at_any_time(prefix: str, confidence: float) -> None:
    values = {f"{prefix}detector.confidence": confidence, f"{prefix}detector.classes": ["car", 3]}
    now = live_values(with_live_values(TWO, values, disarmed=False))
    assert now == FILE | values | {f"{prefix}detector.classes": ("car", 3)}


def test_of_several_all_are_set_or_none() -> None:
    both = {"guidance.max_altitude_m": 20, "guidance.max_distance_m": 500.0}
    with pytest.raises(ConfigurationError) as refused:
        with_live_values(TWO, both, disarmed=False)
    assert [problem.partition(":")[0] for problem in refused.value.problems] == ["guidance.max_distance_m"]
    now = with_live_values(TWO, both, disarmed=True)
    assert (now.guidance.max_altitude_m, now.guidance.max_distance_m) == (20.0, 500.0)


@pytest.mark.parametrize(
    "key",
    [
        "guidance.fence_include",
        "guidance.max_yaw_rate_radps",
        "vehicle.url",
        "detector.model",
        "cameras.down.detector.model",
        "cameras.up.detector.confidence",
        "cameras..detector.confidence",
        "detector",
        "",
        "guidance.__class__",
        "guidance.max_altitude_m.real",
    ],
)
def test_nothing_else_can_be_changed(key: str) -> None:
    with pytest.raises(ConfigurationError):
        with_live_values(TWO, {key: 1.0}, disarmed=True)


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("guidance.max_altitude_m", "-1"),
        ("guidance.max_altitude_m", "0.5"),  # below the minimum altitude
        ("guidance.max_climb_mps", "11"),
        ("detector.confidence", "1.5"),
    ],
)
def test_invalid_value_has_the_error_of_the_start(key: str, text: str) -> None:
    with pytest.raises(ConfigurationError) as at_the_start:
        changed(TWO, {key: text})
    with pytest.raises(ConfigurationError) as now:
        with_live_values(TWO, {key: float(text)}, disarmed=True)
    assert str(now.value) == str(at_the_start.value).replace("given as a flag", "to be set")


@pytest.mark.parametrize("value", [None, True, "20", [20], {"a": 1}, [], 10**30, float("nan"), float("inf")])
@pytest.mark.parametrize("key", ["guidance.max_altitude_m", "detector.confidence"])
def test_value_of_another_kind_is_refused(key: str, value: Any) -> None:
    with pytest.raises(ConfigurationError, match=key):
        with_live_values(TWO, {key: value}, disarmed=True)


@pytest.mark.parametrize("value", [None, "car", 3, [None], [["car"]], [{}], [1.5]])
def test_classes_of_another_kind_are_refused(value: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"detector\.classes"):
        with_live_values(TWO, {"detector.classes": value}, disarmed=True)


SETS = st.lists(
    st.tuples(st.sampled_from(LIMIT_KEYS), st.floats(0.1, 300.0), st.sampled_from([None, True, False])),
    max_size=12,
)


@given(SETS)
@settings(max_examples=200, deadline=None)
def test_no_sequence_of_sets_widens_a_limit_while_armed(sets: list[tuple[str, float, bool | None]]) -> None:
    """From arming on, nothing is wider than it was then: than the file's, if it was not changed before."""
    now, armed_with = TWO, FILE
    for key, value, disarmed in sets:
        if disarmed:
            armed_with = live_values(now)
        try:
            now = with_live_values(now, {key: value}, disarmed=bool(disarmed))
        except ConfigurationError:
            continue
        if disarmed:
            armed_with = live_values(now)
        assert not [each for each in LIMIT_KEYS if is_wider(each, live_values(now)[each], armed_with[each])]


def test_text_is_read_as_a_flag() -> None:
    assert live_value_of_text("guidance.max_altitude_m", "20") == 20.0
    assert live_value_of_text("cameras.down.detector.classes", "car, 3") == ("car", 3)
    for key, text in (("guidance.max_altitude_m", "high"), ("guidance.brake_s", "1"), ("x", "1")):
        with pytest.raises(ConfigurationError, match=key):
            live_value_of_text(key, text)


def test_description_has_range_and_direction() -> None:
    assert describe_live("guidance.min_altitude_m") == {
        "expected": "a number, above 0, at most 1000",
        "minimum": 0,
        "maximum": 1000,
        "narrower": "larger",
    }
    assert describe_live("cameras.down.detector.confidence")["maximum"] == 1
    assert describe_live("detector.classes")["minimum"] is None
    assert len(LIMITS) == 6
