"""Plain sentences to commands, without a model."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.guidance.grammar import parse
from companion.language.clauses import UnclearError
from companion.language.numbers_in_words import with_numbers
from companion.language.scene import SceneObject
from companion.language.sentences import is_stop, understand
from tests.companion.language.sentence_table import CLASSES, SCENE, SENTENCES, UNCLEAR


def test_table_has_a_hundred_sentences() -> None:
    assert len({text for text, _ in SENTENCES}) >= 100


@pytest.mark.parametrize(("text", "expected"), SENTENCES, ids=[text for text, _ in SENTENCES])
def test_sentence_means_these_commands(text: str, expected: tuple[str, ...]) -> None:
    written = tuple(str(intent) for intent in understand(text, SCENE).intents)
    assert written == tuple(word if word.startswith("?") else str(parse(word)) for word in expected)


@pytest.mark.parametrize(("text", "word"), UNCLEAR, ids=[text for text, _ in UNCLEAR])
def test_unclear_sentence_is_asked_back(text: str, word: str) -> None:
    with pytest.raises(UnclearError) as caught:
        understand(text, SCENE)
    assert word in str(caught.value).lower()
    assert "\n" not in str(caught.value)


def test_vehicle_is_the_class_in_view_or_asked_back() -> None:
    assert str(understand("find a vehicle", SCENE).intents[0]) == "seek car"
    with pytest.raises(UnclearError, match=r"car .*truck .*bus"):
        understand("find a vehicle", replace(SCENE, objects=()))


def test_unseen_colour_is_searched_for_once() -> None:
    text = "take off to 5 m, find the white truck and circle it"
    first = understand(text, SCENE)
    assert [str(each) for each in first.intents] == ["takeoff altitude=5", "seek truck"]
    assert first.done == 1
    seen = replace(SCENE, objects=(SceneObject("truck", 9, "white"),))
    assert [str(each) for each in understand(text, seen, first.done).intents] == ["orbit track=9"]
    with pytest.raises(UnclearError, match="red car"):
        understand(text, SCENE, first.done)


def test_pose_is_known_again_after_the_search() -> None:
    text = "take off to 5 m, find the white truck and then go up three metres"
    seen = replace(SCENE, objects=(SceneObject("truck", 9, "white"),))
    again = understand(text, seen, understand(text, SCENE).done)
    assert [str(each) for each in again.intents] == [str(parse("goto forward=0 right=0 altitude=8"))]


@pytest.mark.parametrize("text", ["find the red car", "circle the red car", "follow the red one"])
def test_unknown_colour_is_asked_back(text: str) -> None:
    unknown = replace(SCENE, objects=tuple(replace(each, colour=None) for each in SCENE.objects))
    for done in (None, 0):
        with pytest.raises(UnclearError, match=r"colours .*car \(track 3\)"):
            understand(text, unknown, done)
    one = replace(SCENE, objects=(SCENE.objects[0], SceneObject("car", 5)))
    sentence = "circle the red car"
    assert "track=3" in str(understand(sentence, one).intents[0])


def test_unknown_height_and_heading_are_asked_back() -> None:
    blind = replace(SCENE, altitude_m=None, yaw_rad=None, last=None)
    for text in (
        "go up three metres",
        "go ten metres east",
        "turn left",
        "twice as far",
        "circle it twice at 3 m",
    ):
        with pytest.raises(UnclearError):
            understand(text, replace(blind, objects=()))


STOPS = """stop|STOP!|please stop|Stop now.|halt|abort|freeze!|stop, now|stop, please|stop stop|Stop. Stop!
stop right now|stop immediately|stop at once|stop the drone|stop following the car|stop flying|emergency stop
Emergency stop!|hey drone, stop what you are doing|Please, stop|stop the search|abort the landing
abort take off|halt, halt"""


@pytest.mark.parametrize("text", STOPS.replace("\n", "|").split("|"))
def test_stop_is_recognized_without_another_verb(text: str) -> None:
    assert is_stop(text)
    assert [str(intent) for intent in understand(text, SCENE).intents] == ["stop"]


@pytest.mark.parametrize(
    "text",
    [
        "do not stop",
        "why did you stop?",
        "stop at the car",
        "stop when you see a car",
        "stop in ten seconds",
        "stop and land",
        "stop, come home",
        "abort and land",
        "stopped",
        "",
    ],
)
def test_other_sentences_are_not_stop(text: str) -> None:
    assert not is_stop(text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("two hundred and five metres", "205 m"),
        ("a hundred feet", "30.48 m"),
        ("one point two five km", "1250 m"),
        ("thirty-six kilometres per hour", "10 m/s"),
        ("a minute and a half", "90 s"),
        ("half a minute", "30 s"),
        ("twice as far", "twice as far"),
        ("twice", "2 x"),
        ("forty five degrees", "45 deg"),
    ],
)
def test_numbers_and_units_in_words(text: str, expected: str) -> None:
    assert with_numbers(text) == expected


def test_every_class_has_a_singular_and_a_plural() -> None:
    for name in CLASSES:
        assert str(understand(f"look for a {name}", SCENE).intents[0]) == str(parse(f"seek {name}"))
    plural = "look for buses"
    assert str(understand(plural, SCENE).intents[0]) == "seek bus"
