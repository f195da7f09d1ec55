"""Registration of commands by plug-ins, and how one that cannot be loaded is named."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import vision.detector  # noqa: F401  (registers its kinds of detectors)
from companion.guidance.command import COMMANDS, NO_CONTEXT
from companion.guidance.grammar import describe, json_schema, markdown, parse
from companion.settings.plugins import PluginError, load_plugins

PLUGIN = """
from typing import Annotated

from companion.guidance.command import Number
from companion.guidance.behaviour import Behaviour, Outcome
from companion.guidance.command import Command
from companion.guidance.command import behaviour


@behaviour("{word}", "wait for some time")
class Wait(Command):
    duration_s: Annotated[float, Number("duration", "s", 0.0, 60.0, "how long")] = 5.0

    def build(self, context):
        return WaitBehaviour()


class WaitBehaviour(Behaviour):
    name = "{word}"

    def update(self, dt_s, context):
        return Outcome(True, "waited")
"""


PLUGIN_DETECTOR = """
from vision.object_detector import detector

@detector("yolo", "another one")
def opener(settings): ...
"""


@pytest.fixture(autouse=True)
def _table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Restores the command table and the loaded modules."""
    before, modules = dict(COMMANDS), set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    COMMANDS.clear()
    COMMANDS.update(before)
    for name in set(sys.modules) - modules:
        del sys.modules[name]


def test_named_module_adds_its_command(tmp_path: Path) -> None:
    (tmp_path / "plugin_of_a_user.py").write_text(PLUGIN.format(word="wait"))
    assert "wait" not in COMMANDS
    load_plugins(["plugin_of_a_user"])
    command = parse("wait 7s")
    assert str(command) == "wait duration=7"
    assert command.build(NO_CONTEXT).name == "wait"
    assert "wait [duration=5]" in describe()
    assert json_schema()["$defs"]["wait"]["properties"]["duration"]["unit"] == "s"
    assert "## wait" in markdown()


def test_entry_point_gives_a_module_a_short_name(tmp_path: Path) -> None:
    (tmp_path / "a_long_module_name.py").write_text(PLUGIN.format(word="wait"))
    metadata = tmp_path / "waiting-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: waiting\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[companion.plugins]\nwaiting = a_long_module_name\n")
    load_plugins([])
    assert "wait" not in COMMANDS
    load_plugins(["waiting"])
    assert "wait" in COMMANDS


@pytest.mark.parametrize(
    ("name", "source", "traced"),
    [
        ("no_such_module", None, False),
        ("with_a_bug", "1 / 0", True),
        ("needs_what_is_not_there", "import no_such_library_at_all", True),
        ("takes_a_word_of_ours", PLUGIN.format(word="hold"), False),
        ("two_words", PLUGIN.format(word="wait here"), False),
        (
            "no_argument",
            PLUGIN.format(word="wait").replace('Annotated[float, Number("duration", ', "float #"),
            False,
        ),
        ("takes_a_kind_of_ours", PLUGIN_DETECTOR, False),
    ],
)
def test_plugin_that_cannot_be_loaded_is_named(
    tmp_path: Path, name: str, source: str | None, traced: bool, caplog: pytest.LogCaptureFixture
) -> None:
    if source is not None:
        (tmp_path / f"{name}.py").write_text(source)
    before = dict(COMMANDS)
    with pytest.raises(PluginError, match=name) as error:
        load_plugins([name])
    assert before == COMMANDS
    assert "\n" not in str(error.value)
    # A traceback helps where the plug-in's own code fails.
    assert [record.exc_info is not None for record in caplog.records] == [True] * traced
