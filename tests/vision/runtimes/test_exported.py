"""Metadata of exported files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.runtimes.base import RuntimeUnusableError
from vision.runtimes.exported import FORMAT, MAGIC, ExportedFacts, kind_of, split_facts, with_facts

PATH = Path("net.engine")
FACTS = ExportedFacts(
    ("person", "car"), (8, 16, 32), 16, False, 640, "ab" * 32, None, "YOLOv8", {"licence": "é"}
)

names = st.text(min_size=1, max_size=20)


@given(
    class_names=st.lists(names, min_size=1, max_size=5).map(tuple),
    strides=st.lists(st.integers(1, 128), min_size=1, max_size=4).map(tuple),
    reg_max=st.integers(1, 32),
    end_to_end=st.booleans(),
    fixed_size=st.none() | st.tuples(st.integers(32, 640), st.integers(32, 640)),
    metadata=st.dictionaries(names, st.integers() | names, max_size=3),
)
def test_facts_survive_the_round_trip(**values: object) -> None:
    facts = ExportedFacts(image_size=320, source_sha256="00", model_family="YOLO11", **values)  # type: ignore[arg-type]
    assert ExportedFacts.from_json(facts.to_json(), PATH) == facts


@given(text=st.text() | st.recursive(st.none() | st.integers() | st.text(), st.lists).map(json.dumps))
def test_anything_else_is_rejected_by_name(text: str) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"net\.engine"):
        ExportedFacts.from_json(text, PATH)


@pytest.mark.parametrize(
    "change",
    [
        {"format": "other"},
        {"class_names": []},
        {"class_names": [1]},
        {"strides": [0]},
        {"strides": ["8"]},
        {"reg_max": 1.5},
        {"fixed_size": [1]},
        {"metadata": []},
        {"end_to_end": 1},
        {"more": 1},
    ],
    ids=str,
)
def test_invalid_facts_are_rejected(change: dict[str, object]) -> None:
    text = json.dumps(json.loads(FACTS.to_json()) | change)
    with pytest.raises(RuntimeUnusableError, match="companion models export"):
        ExportedFacts.from_json(text, PATH)


def test_facts_give_the_output_layout() -> None:
    head = FACTS.head()
    assert (head.strides, head.reg_max, head.end_to_end, head.class_ids) == ((8, 16, 32), 16, False, (0, 1))
    assert head.kinds == ("sides", "classes")


def test_a_plan_keeps_its_facts_before_it() -> None:
    facts, plan = split_facts(with_facts(FACTS, b"the plan"), PATH)
    assert facts == FACTS
    assert bytes(plan) == b"the plan"


@given(cut=st.integers(0, len(with_facts(FACTS, b"")) - 1))
def test_a_plan_that_is_cut_short_is_rejected(cut: int) -> None:
    with pytest.raises(RuntimeUnusableError):
        split_facts(with_facts(FACTS, b"")[:cut], PATH)


@given(content=st.binary() | st.binary().map(lambda tail: MAGIC + tail))
def test_foreign_plan_is_rejected(content: bytes) -> None:
    with pytest.raises(RuntimeUnusableError, match=r"net\.engine"):
        split_facts(content, PATH)


def test_kind_follows_from_the_suffix() -> None:
    assert kind_of(Path("a/b.onnx")) == "onnx"
    assert kind_of(Path("b.xml")) == "openvino"
    assert kind_of(Path("b.engine")) == "tensorrt"
    assert kind_of(Path("b.torchscript")) == "torchscript"
    assert kind_of(Path("b.pt")) is None
    assert FORMAT.endswith(".v1")
