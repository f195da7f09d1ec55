"""The load of the computer in messages."""

from __future__ import annotations

import ast
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from companion.cli.flags import plain_errors
from companion.guidance.behaviour import Outcome
from companion.guidance.interface import CommandResult
from companion.host.journal import log_to_standard_error
from companion.host.load import SLOWNESS, busy_text, with_load
from companion.service.command_handler import _with_load
from companion.service.event import EventLog

ROOT = Path(__file__).parents[3]
TOO_LONG = re.compile(r"(?:within|for|after) \{\}\s?s\b|too slow|paused for")
# Messages with a time that are not about a slow computer: the vehicle, an object, a person or a plan.
OTHERS = (
    "the service of vehicle {} has been silent for",
    "no answer within {} s; `companion echo status`",
    "no answer from vehicle",
    "no answer within",
    "no answer of the service within",
    "no settings of vehicle",
    "no status for",
    "no connection within",
    "no end within",
    "it answers too slowly",
    "the computer was suspended for",
    "not confirmed within",
    "not finished within",
    "autopilot heartbeat lost: none for",
    "no way for",
    "position or attitude lost for",
    "lost {} for",
    "unseen for",
    "followed {} for",
    "waited for",
    "gimbal: not pointing",
    "held for",
    "no progress for",
    "{} for {} s",
    "not there after",
    "gimbal: after",
    "position lost for",
    "timed out after",
    "flown for",
    "not ended after",
    "camera frozen: the same",
    "perception restored after",
    "no attitude received within",
    "no autopilot heartbeat within",
    "no heartbeat for",
    "could not be opened within",
    "MAVSDK did not find the autopilot within",
    "in progress, but no further answer for",
    "the vehicle did not report",
    "without setpoints {} {} after",
    "streams missing or too slow",
    "recovered after",
    "the selected object is not seen any more",
)
PARTS = ("for {} s", " within {} s", "within {} s", "no {} for {} s")  # of other messages


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Two cores, and the load that a test sets."""
    value = [18.2]
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 3}, raising=False)
    monkeypatch.setattr(os, "getloadavg", lambda: (value[0], 0.0, 0.0))
    return value


@pytest.mark.parametrize(
    ("value", "words"), [(1.9, ()), (2.0, ()), (2.6, ("2 cores", "load 3")), (18.2, ("load 18",))]
)
def test_busy_computer_is_named_with_cores_and_load(
    value: float, words: tuple[str, ...], load: list[float]
) -> None:
    load[0] = value
    text = busy_text()
    assert bool(text) == bool(words)
    assert [word for word in words if word not in text] == []


@pytest.mark.parametrize("words", SLOWNESS)
def test_message_of_slowness_gets_the_load_once(words: str, load: list[float]) -> None:
    text = f"the camera: {words} 3 s"
    assert with_load(with_load(text)) == text + busy_text()
    load[0] = 0.5
    assert with_load(text) == text
    assert with_load("no such file") == "no such file"


def texts_of(path: Path) -> Iterator[str]:
    """The strings of a module without its documentation, `{}` for each value."""
    tree = ast.parse(path.read_text())
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    skipped |= {
        id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values
    }
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield re.sub(r"%[.\d]*[dgfs]", "{}", node.value)


def test_every_message_of_slowness_is_known() -> None:
    texts = [
        text
        for package in ("companion", "vision")
        for path in (ROOT / package).rglob("*.py")
        if "bench" not in path.parts and path.name != "load.py"
        for text in texts_of(path)
    ]
    timed = [text for text in texts if TOO_LONG.search(text) and text not in PARTS]
    assert [one for one in timed if not any(words in one for words in (*SLOWNESS, *OTHERS))] == []
    written = "\n".join(texts).replace("no {} for", "no frame for no result for")
    assert [words for words in (*SLOWNESS, *OTHERS) if words not in written] == []


def test_load_is_in_events_ends_errors_and_log(
    load: list[float], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load
    shown = []
    log = EventLog(lambda body: shown.append(body["text"]), None)
    log.add("warning", "guidance loop paused for 3.2 s: what was commanded before has ended")
    (end,) = _with_load([CommandResult(1, Outcome(False, "guidance loop paused for 2.0 s"))])
    shown += [log.newest[-1].text, end.outcome.reason]
    with pytest.raises(typer.Exit), plain_errors(ValueError):
        raise ValueError("/dev/video0: no frame within 10 s")
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", logging.WARNING)
    log_to_standard_error("WARNING", "%(message)s")
    logging.getLogger("vision.recording").warning("%s: the encoder was too slow", "flight.webm")
    shown += capsys.readouterr().err.splitlines()
    assert len(shown) == 5
    assert [text for text in shown if not text.endswith("(2 cores, load 18)")] == []
