"""The score of a language model, with a model that answers from a script."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from companion.language.conversation import MAX_TURNS
from companion.language.endpoints import Message
from companion.language.tools import ToolCall
from tools import language_score

LAND, RTL = ToolCall("land", {}), ToolCall("rtl", {})


class ScriptedModel:
    """Answers one after the other; calls nothing after the last."""

    def __init__(self, *answers: Message) -> None:
        self.answers, self.asked = list(answers), 0

    async def answer(
        self, messages: Sequence[Message], tools: list[dict[str, Any]], on_text: Callable[[str], None]
    ) -> Message:
        self.asked += 1
        return self.answers.pop(0) if self.answers else Message("assistant", "Done.")


def calling(*calls: ToolCall) -> Message:
    return Message("assistant", "", calls)


@pytest.mark.parametrize(
    ("text", "expected", "answers", "found"),
    [
        ("land", ["land"], [calling(LAND)], "right"),
        ("land", ["land"], [Message("assistant", '{"name": "land"}')], "right"),
        ("go home and land", ["rtl", "land"], [calling(RTL, LAND)], "right"),
        ("find the red car", ["?seen car track=3"], [calling(ToolCall("seen", {"class": "car"}))], "right"),
        ("find the red car", ["?seen car track=3"], [calling(ToolCall("seen", {}))], "right"),
        ("find the red car", ["?seen car track=3"], [calling(ToolCall("seen", {"class": "bus"}))], "no call"),
        ("land", ["land"], [calling(ToolCall("descend", {})), calling(LAND)], "right"),
        ("twice as far", ["orbit boat radius=20"], [calling(LAND)], "wrong call"),
        ("land", ["land"], [calling(LAND), calling(RTL)], "wrong call"),
        ("land", ["land"], [calling(LAND, RTL)], "wrong call"),
        ("battery", ["?battery"], [calling(ToolCall("battery", {})), calling(LAND)], "wrong call"),
        ("land", ["land"], [calling(ToolCall("descend", {}))], "refused"),
        ("land", ["land"], [], "no call"),
        ("take off", ["takeoff"], [calling(ToolCall("takeoff", {"altitude": 2.5}))], "right"),
        ("make me a sandwich", [], [], "right"),
        ("make me a sandwich", [], [calling(LAND)], "wrong call"),
    ],
)
async def test_verdict_counts_every_command_of_a_sentence(
    text: str, expected: list[str], answers: list[Message], found: str
) -> None:
    assert (await language_score.verdict(text, expected, ScriptedModel(*answers)))[0] == found


async def test_model_that_never_ends_is_asked_as_often_as_in_flight() -> None:
    model = ScriptedModel(*[calling(LAND)] * 3 * MAX_TURNS)
    found, recorder = await language_score.verdict("land", ["land"], model)
    assert (found, model.asked, recorder.executed) == ("wrong call", MAX_TURNS, ["land"] * MAX_TURNS)


def test_score_of_both_tables_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["language_score", "--model", "small", "--every", "1000"])
    monkeypatch.setattr(language_score, "endpoint_of", lambda *_, **__: ScriptedModel(calling(RTL)))
    language_score.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["wrong", "call"]
    assert [line[:26] for line in lines if " of 1 " in line] == [
        "with a call: 0 of 1 right;",
        "unclear: 1 of 1 right; {'r",
    ]


@pytest.mark.parametrize("every", ["0", "-2"])
def test_bad_step_is_one_line_and_exit_code_2(
    every: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["language_score", "--model", "small", "--every", every])
    with pytest.raises(SystemExit) as caught:
        language_score.main()
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("language_score: --every ")
    assert error.endswith(f" 1 or more, got {every}\n")
