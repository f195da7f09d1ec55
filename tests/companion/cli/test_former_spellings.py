"""The former spellings of commands and options: one line with the new one, which is a valid command."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import pytest
import typer

from companion.cli import app
from companion.cli.former import FORMER, Former, former_line
from tests.companion.command_line import companion_here

# What stands for the placeholders of the table.
VALUES = {
    "SOURCE": "a.png",
    "FILE": "a.file",
    "IMAGE": "a.png",
    "FOLDER": "folder",
    "DIR": "folder",
    "COLOUR": "colour",
    "INFRARED": "infrared",
    "IDS": "0..3",
    "NAME": "4X4_50",
    "N": "2",
    "METRES": "0.5",
    "FORMAT": "bgr24",
    "HZ": "5",
    "FRAME": "ned",
    "HOST:PORT": "127.0.0.1:8088",
    "OUTPUT": "out",
    "OUTPUT.mcap": "out.mcap",
    "OUTPUT.tlog": "out.tlog",
    "DATASET": "labelled",
    "TASK": "companion/CartPole-v0",
    "EXPORT": "a.onnx",
}
# What else the new commands need.
REQUIRED = {"calibrate lens": ("--board", "chessboard", "7x5", "--square", "0.03")}
ROWS: list[tuple[Former, tuple[str, ...]]] = [(former, ()) for former in FORMER if not former.only_options]
ROWS += [(former, (option,)) for former in FORMER for option in former.options]
root = functools.cache(typer.main.get_command)


def words_of(spelling: str) -> list[str]:
    return [VALUES.get(word, word) for word in spelling.split()]


def name_of(row: tuple[Former, tuple[str, ...]]) -> str:
    return " ".join((row[0].old, *row[1]))


def check_parses(words: list[str]) -> None:
    """Check that the command and its options are there and take these values, without running it."""
    command: Any = root(app)
    context = command.make_context("companion", words)
    while hasattr(command, "resolve_command"):
        rest = [*context._protected_args, *context.args]
        name, command, rest = command.resolve_command(context, rest)
        rest += REQUIRED.get(" ".join(words[:2]), ())
        context = command.make_context(name, rest, parent=context)


@pytest.mark.parametrize("row", ROWS, ids=name_of)
def test_former_spelling_gives_a_valid_new_one(row: tuple[Former, tuple[str, ...]], tmp_path: Path) -> None:
    former, options = row
    done = companion_here(*words_of(name_of(row)), cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line == f"companion: {former.line(options)}"
    new = line.partition(" is now ")[2].split()
    if new[0] == "companion":
        check_parses([VALUES.get(word, word) for word in new[1:]])
    else:
        assert (Path(__file__).parents[3] / f"{new[-1].replace('.', '/')}.py").exists()


def test_new_spelling_is_not_taken_for_a_former_one() -> None:
    for former, options in ROWS:
        new = former.line(options).partition(" is now companion ")[2]
        assert former_line(words_of(new)) is None


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("detect a.png --voxel 0.1", "--voxel"),
        ("detect a.png --cloud-view a.png", "--cloud-view"),
        ("detect a.png --attitude 0 0 0", "--attitude"),
        ("detect a.png --grey", "--grey"),
        ("detect a.png --level", "--level"),
        ("detect a.png --model none --track", "--track"),
        ("detect a.png --model none --pull", "--pull"),
        ("describe settings --json", "--json"),
        ("describe cameras --markdown", "--markdown"),
        ("describe commands --schema out", "--schema"),
        ("describe topics --check", "--check"),
        ("send hold --check", "--check"),
        ("send hold --file demo", "--file"),
        ("send", "--file"),
        ("view --pull", "--pull"),
        ("learn train --algorithm sac", "--algorithm"),
        ("learn train --policy companion/CartPole-v0 --data labelled", "--data"),
        ("learn train --policy companion/CartPole-v0 --hours 1", "--hours"),
        ("learn train --batch-size 4", "--batch-size"),
        ("models show --runtime torch", "--runtime"),
        ("models show default --folder models", "--folder"),
        ("models show default --images photos", "--images"),
        ("calibrate lens a --board chessboard 7x5 --square 0.03 --calibration a.yaml", "--calibration"),
        (
            "calibrate lens a --depth-source b --board chessboard 7x5 --square 0.03 --report out",
            "--report",
        ),
        ("calibrate lens a --depth-source b --board chessboard 7x5 --square 0.03", "--calibration"),
        ("log convert flight.mcap out.csv", "out.csv"),
        ("demo --synthetic", "--synthetic"),
    ],
)
def test_option_of_something_else_is_refused_by_name(words: str, named: str, tmp_path: Path) -> None:
    done = companion_here(*words.split(), cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert named in line
    assert not list(tmp_path.iterdir())
