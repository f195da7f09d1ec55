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
