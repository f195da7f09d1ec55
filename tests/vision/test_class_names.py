"""Class names as people and files write them, in every place that reads one."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.behaviours.patrol import Patrol
from companion.guidance.command import GrammarError
from companion.guidance.grammar import parse
from companion.language.nouns import classes_of
from companion.language.tools import ToolCall, read_call
from companion.learning.evaluate import map_classes
from companion.settings import Settings
from mavlink_sim.camera.scene_file import parse_scene
from vision.class_names import class_named, fold_name, joined_names
from vision.evaluation.datasets import Dataset, DatasetError, open_dataset
from vision.object_detector import resolve_classes

UMLAUT = "Fußgänger"
NAMES = ("person", "traffic light", "fork, knife", UMLAUT, "T-shirt", "fork")
SPELLINGS = {
    "person": ("Person", "PERSON", " person "),
    "traffic light": ("traffic_light", "traffic-light", "Traffic Light", "trafficlight"),
    "fork, knife": ("Fork, Knife", "fork,knife"),
    UMLAUT: (unicodedata.normalize("NFD", UMLAUT), UMLAUT.upper(), unicodedata.normalize("NFD", "fußgänger")),
    "T-shirt": ("t-shirt", "T shirt", "t_shirt"),
    "fork": ("Fork",),
}
ALL = [(written, name) for name, others in SPELLINGS.items() for written in (name, *others)]


@pytest.mark.parametrize(("written", "name"), ALL)
def test_every_place_reads_other_spellings(written: str, name: str) -> None:
    assert class_named(written, NAMES) == name
    assert resolve_classes([written], NAMES) == (NAMES.index(name),)
    command = parse(f'approach "{written}"', NAMES)
    assert command == parse(f'approach "{name}"', NAMES)
    assert parse(str(command), NAMES) == command
    assert str(read_call(ToolCall("approach", {"class": written}), NAMES)) == str(command)
    assert str(read_call(ToolCall("seen", {"class": written}), NAMES)) == f"?seen {name}"


@pytest.mark.parametrize("name", [UMLAUT, unicodedata.normalize("NFD", UMLAUT)])
def test_nouns_of_sentences_have_composed_accents(name: str) -> None:
    assert classes_of("fußgänger", (name,)) == (name,)


@given(st.text(max_size=20))
def test_fold_is_stable_over_normalization(name: str) -> None:
    folded = fold_name(name)
    assert fold_name(folded) == folded
    assert (
        fold_name(unicodedata.normalize("NFD", name))
        == folded
        == fold_name(unicodedata.normalize("NFC", name))
    )


def test_names_that_differ_in_case_alone_are_ambiguous_unless_exact() -> None:
    names = ("Person", "person", "car")
    assert resolve_classes(["person"], names) == (1,)
    for read in (
        lambda: class_named("PERSON", names),
        lambda: resolve_classes(["PERSON"], names),
        lambda: parse("approach PERSON", names),
    ):
        with pytest.raises(ValueError, match="'Person' or 'person'"):
            read()


def test_class_that_a_model_has_twice_is_both() -> None:
    assert resolve_classes(["Car"], ("car", "person", "car")) == (0, 2)


@pytest.mark.parametrize("name", ["persn", "dragon"])
def test_unknown_name_lists_near_ones(name: str) -> None:
    for read in (lambda: resolve_classes([name], NAMES), lambda: parse(f"approach {name}", NAMES)):
        with pytest.raises(ValueError, match="person"):
            read()


def test_number_is_a_class_of_a_filter_and_none_of_a_command() -> None:
    assert resolve_classes(["0", 2], NAMES) == (0, 2)
    with pytest.raises(ValueError, match=r"0\.\.5, not 6"):
        resolve_classes(["6"], NAMES)
    with pytest.raises(GrammarError, match="track=N"):
        parse("approach 0", NAMES)
    assert str(parse("approach 7", ("5", "7"))) == "approach 7"


def test_names_with_commas_of_a_split_list_are_joined() -> None:
    assert joined_names(["person", "fork", "knife"], NAMES) == ("person", "fork", "knife")
    names = ("person", "fork, knife")
    assert resolve_classes(["person", "Fork", " knife"], names) == (0, 1)
    with pytest.raises(ValueError, match="'knife'"):  # "fork" is a class too: nothing is guessed
        resolve_classes(["fork", "knife"], NAMES)


def test_patrol_keeps_a_name_with_a_comma() -> None:
    names = ("person", "fork, knife")
    command = parse('patrol points="0,0 10,0" classes="Person,fork, knife"', names)
    assert isinstance(command, Patrol)
    assert command.names == names
    again = parse(str(command), names)
    assert isinstance(again, Patrol)
    assert again.names == names
    unchecked = parse(str(command))
    assert isinstance(unchecked, Patrol)
    assert unchecked.names == names


def test_height_of_a_class_is_found_by_any_spelling() -> None:
    settings = Settings.model_validate({"detector": {"class_heights_m": ("Traffic_Light:0.9",)}})
    assert settings.detector.heights() == {fold_name("traffic light"): 0.9}
    twice = {"detector": {"class_heights_m": ("person:1.7", "Person:1.8")}}
    with pytest.raises(ValueError, match="twice"):
        Settings.model_validate(twice)


def test_class_of_a_scene_is_read_in_any_case() -> None:
    scene = parse_scene("[[objects]]\nclass = 'Person'\nplace_m = [1, 2]\n")
    assert scene.world.objects[0].class_name == "person"


@pytest.mark.parametrize(
    "names",
    [
        '["fork, knife", Person]',
        '{0: "fork, knife", 1: Person}',
        '{"0": "fork, knife", "1": Person}',
        '{1: Person, 0: "fork, knife"}',
        '\n  - "fork, knife"\n  - Person',
        '\n  "1": Person\n  "0": "fork, knife"',
    ],
)
def test_names_of_a_data_set_in_every_form(names: str, tmp_path: Path) -> None:
    dataset = labelled(tmp_path, names)
    assert dataset.class_names == ("fork, knife", "Person")
    mapping = map_classes(("person", "Fork, Knife", "car"), dataset)
    assert mapping.names == ("fork, knife", "Person")
    assert mapping.unknown == ()


def test_gap_in_the_numbers_of_names_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"1 .*missing"):
        labelled(tmp_path, "{0: person, 2: car}")


def test_classes_that_a_model_has_twice_count_both(tmp_path: Path) -> None:
    mapping = map_classes(("car", "person", "Car"), labelled(tmp_path, "[car, person]"))
    np.testing.assert_array_equal(mapping.of_model, [0, 1, 0])


def labelled(folder: Path, names: str) -> Dataset:
    (folder / "images").mkdir()
    (folder / "labels").mkdir()
    (folder / "images" / "a.png").write_bytes(b"")
    (folder / "labels" / "a.txt").write_text("1 0.5 0.5 0.2 0.2\n")
    (folder / "data.yaml").write_text(f"val: images\nnames: {names}\n", "utf-8")
    return open_dataset(folder / "data.yaml", split="val")
