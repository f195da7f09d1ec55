"""Sentences and questions answered by patterns, without a model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from companion.language.scene import SceneObject
from tests.companion.language.language_server import ollama, serving
from tests.companion.language.sentence_table import SCENE
from tests.companion.language.test_conversation import DENIED, WARNING, FakeVehicle, Talk, tool_results


async def test_unseen_object_is_searched_for_then_flown_to() -> None:
    vehicle = FakeVehicle(replace(SCENE, objects=()))
    talk = Talk(vehicle=vehicle)
    command = vehicle.command

    async def found(text: str) -> dict[str, Any]:
        vehicle.seen = replace(SCENE, objects=(SceneObject("truck", 9, "green"),))
        return await command(text)

    vehicle.command = found  # type: ignore[method-assign]
    sentence = "find the green truck and circle it twice at ten metres"
    assert await talk.ask(sentence)
    assert vehicle.commands == ["seek truck", "orbit radius=10 laps=2 track=9"]
    assert talk.asked == 2


async def test_questions_and_failures_in_words() -> None:
    talk = Talk(vehicle=FakeVehicle(refused="land"))
    seen, which = "what do you see?", "follow the car"
    assert await talk.ask(seen)
    assert "red car (track 3) 12 m away" in talk.lines[-1]
    assert await talk.ask("battery")
    assert "81" in talk.lines[-1]
    assert not await talk.ask("land")
    assert await talk.ask("why not?")
    assert DENIED in talk.lines[-1]
    assert WARNING in talk.lines[-1]
    assert not await talk.ask(which)
    assert "which car" in talk.lines[-1]


CAR_3, CAR_5 = (
    "red car (track 3) 12 m away 20 deg to the left",
    "blue car (track 5) 20 m away 10 deg to the right",
)


@pytest.mark.parametrize(
    ("question", "answer"),
    [
        ("where is the red car?", f"seen: {CAR_3}"),
        ("find the red car", f"seen: {CAR_3}"),
        ("where is the farthest car", f"seen: {CAR_5}"),
        ("do you see any vehicles", f"seen: {CAR_3}; {CAR_5}"),
        ("where is the nearest dog", "seen: no dog"),
        ("is there a car on the right", f"seen: {CAR_5}"),
        ("how many cars are on the left", f"seen: {CAR_3}"),
        ("is there a person on the left", "seen: no person"),
        ("where is the green car", "seen: no green car"),
        ("find track 12", "seen: no object track 12"),
    ],
)
async def test_question_is_answered_with_the_objects_asked_for(question: str, answer: str) -> None:
    talk = Talk()
    assert await talk.ask(question)
    assert talk.lines == [answer]


@pytest.mark.parametrize("question", ["where is the red car", "where is the nearest car"])
async def test_question_about_what_is_not_known_is_asked_back(question: str) -> None:
    talk = Talk(vehicle=FakeVehicle(replace(SCENE, objects=(SceneObject("car", 3), SceneObject("car")))))
    assert not await talk.ask(question)
    assert "car (track 3)" in talk.lines[-1]


FAULT = "no detections received: perception is failed"


async def test_model_gets_an_error_without_detections() -> None:
    async with serving(ollama(calls=[("seen", {"class": "car"})]), ollama("I am blind.")) as script:
        talk = Talk(script.url, vehicle=FakeVehicle(replace(SCENE, objects=(), fault=FAULT)))
        question = "model: is the way free?"
        assert await talk.ask(question)
        assert tool_results(script) == [{"error": FAULT}]


async def test_described_object_is_not_searched_for_without_detections() -> None:
    talk = Talk(vehicle=FakeVehicle(replace(SCENE, objects=(), fault=FAULT)))
    sentence = "circle the red car"
    assert not await talk.ask(sentence)
    assert FAULT in talk.lines[-1]
    assert (talk.asked, talk.vehicle.commands) == (0, [])


@pytest.mark.parametrize(
    ("sentences", "lines"),
    [
        (["circle track 3 at ten metres"], ["orbit radius=10 track=3"]),
        (["circle track 3"], ["orbit track=3"]),
        (["circle track 3 at five metres", "twice as far"], ["orbit radius=10 track=3"]),
        (
            ["find a boat and circle it once clockwise at ten metres"],
            [
                "mission plan: 2 steps",
                "1. seek boat → orbit boat radius=10 laps=1 direction=clockwise; on failure → abort",
                "2. orbit boat radius=10 laps=1 direction=clockwise → end; on failure → abort",
            ],
        ),
    ],
)
async def test_plan_shows_stated_values_that_equal_the_default(
    sentences: list[str], lines: list[str]
) -> None:
    talk = Talk(yes=True)
    for sentence in sentences:
        talk.lines.clear()
        await talk.ask(sentence)
    assert talk.lines[: len(lines)] == lines


async def test_newest_command_is_what_it_refers_to() -> None:
    talk = Talk()
    for sentence in ("circle the boat at ten metres", "twice as far", "the other way round"):
        assert await talk.ask(sentence)
    orbit = "orbit boat radius="
    assert talk.vehicle.commands == [f"{orbit}10", f"{orbit}20", f"{orbit}20 direction=counterclockwise"]
