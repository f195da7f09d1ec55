"""YAML read as plain data, with limits."""

from __future__ import annotations

import contextlib
import tracemalloc

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vision.plain_yaml import PlainDumper, PlainYamlError, load_plain_yaml

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**17), 10**17)
    | st.floats(allow_nan=False)
    | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=20,
)


@settings(max_examples=100, deadline=None)
@given(PLAIN)
@example({"0E0": None, "person": ["1e5", "no", ".5", 1e5, 5e-324]})
def test_round_trip(value: object) -> None:
    assert load_plain_yaml(yaml.dump(value, Dumper=PlainDumper)) == value


def test_class_names_stay_strings() -> None:
    text = "names: [no, yes, on, off, y, 1:30, 2026-11-21, 0x1F, 010, person]"
    assert load_plain_yaml(text)["names"] == [
        *("no", "yes", "on", "off", "y", "1:30", "2026-11-21", "0x1F", "010", "person")
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param("a: 1\nb: !!python/object/apply:os.system [id]", "line 2: the tag", id="a program"),
        pytest.param("a: &x [1]\nb: *x", "line 1: anchors", id="an alias"),
        pytest.param("a: 1\na: 2", "duplicate key 'a'", id="a key twice"),
        pytest.param("? [1, 2]\n: 3", "plain value", id="a list as key"),
        pytest.param("a: [1, 2", "line [12]: ", id="an open bracket"),
        pytest.param("a: \x00", "characters", id="a control character"),
        pytest.param("--- 1\n--- 2\n", "document", id="two documents"),
        pytest.param("[" * 100 + "]" * 100, "levels deep", id="deep"),
        pytest.param("[" + "[]," * 200_000 + "]", "more than 100000 values", id="many"),
        pytest.param(" " * (3 << 20), "characters", id="long"),
    ],
)
def test_anything_else_is_rejected_in_one_line(text: str, expected: str) -> None:
    with pytest.raises(PlainYamlError, match=expected) as error:
        load_plain_yaml(text)
    assert "\n" not in str(error.value)


@settings(max_examples=200, deadline=None)
@given(st.text(alphabet=st.sampled_from("[]{}:,-&*!|>'\"#%@`\n \tab01."), max_size=60) | st.text(max_size=60))
def test_any_text_is_data_or_a_named_error(text: str) -> None:
    with contextlib.suppress(PlainYamlError):
        load_plain_yaml(text)


def test_many_values_are_rejected_before_they_are_built() -> None:
    text = "[" + "{}," * 600_000 + "]"
    tracemalloc.start()
    try:
        with pytest.raises(PlainYamlError):
            load_plain_yaml(text)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3 * len(text)
