"""What systemd's journal receives: the bytes that a process writes to a socket like the journal's."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

LINES = """
import logging, os, sys, threading
from companion.cli import commands
from companion.host.journal import is_journal, log_to_standard_error
from companion.operator.line_output import use_for_standard_error
from companion.perception.process import log_printed

commands.app = lambda: None
commands.main()
use_for_standard_error()
log_to_standard_error("DEBUG", "%(levelname)s %(message)s")
for name in ("debug", "info", "warning", "error", "critical"):
    getattr(logging, name)("%s one\\ntwo", name)
reading, writing = os.pipe()
os.write(writing, b"of the worker\\n")
os.close(writing)
log_printed(reading, 7)
child = "from companion.host.journal import log_to_standard_error as f; import logging"
child += "; f('INFO', '%(message)s');"
child += "logging.error('of a program'); print('out')"
import subprocess
done = subprocess.run([sys.executable, "-c", child], capture_output=True, text=True)
for line in (done.stderr + done.stdout).splitlines():
    logging.info(line)
raise RuntimeError("at last")
"""


def journal_of(program: list[str], cwd: Path, *, other: bool = False) -> tuple[int, list[str]]:
    """Run a program whose standard error is a socket; return its exit code and the lines that came.

    Args:
        other: JOURNAL_STREAM names another socket, as in what a unit starts.
    """
    ours, theirs = socket.socketpair()
    with ours, theirs, ours.makefile("rb") as reader:
        status = os.fstat(theirs.fileno())
        inode = status.st_ino + (1 if other else 0)
        environment = {**os.environ, "JOURNAL_STREAM": f"{status.st_dev}:{inode}", "NO_COLOR": "1"}
        with subprocess.Popen(
            program,
            stdout=theirs.fileno(),
            stderr=theirs.fileno(),
            stdin=subprocess.DEVNULL,
            cwd=cwd,
            env=environment,
        ) as process:
            try:
                theirs.close()
                lines = reader.read().decode().splitlines()
                return process.wait(60), lines
            finally:
                process.kill()


def test_every_line_has_the_priority_of_its_level(tmp_path: Path) -> None:
    code, lines = journal_of([sys.executable, "-c", LINES], tmp_path)
    assert code == 1
    expected = [("7", "debug"), ("6", "info"), ("4", "warning"), ("3", "error"), ("3", "critical")]
    for (priority, name), first, second in zip(expected, lines[0:10:2], lines[1:10:2], strict=True):
        assert (first, second) == (f"<{priority}>{name.upper()} {name} one", f"<{priority}>two")
    assert lines[10:13] == ["<4>WARNING of the worker", "<6>INFO of a program", "<6>INFO out"]
    assert lines[13].startswith("<3>Traceback ")
    assert lines[-1] == "<3>RuntimeError: at last"
    assert all(re.match(r"<[3467]>", line) for line in lines)


def test_no_priorities_where_it_is_not_the_journal(tmp_path: Path) -> None:
    _, lines = journal_of([sys.executable, "-c", LINES], tmp_path, other=True)
    assert lines[0] == "DEBUG debug one"
    assert not [line for line in lines if line.startswith("<")]


@pytest.mark.parametrize(
    ("arguments", "priority", "expected"),
    [
        (["run", "--source", "absent.mp4"], "<3>", 2),
        (["run", "--nonsense"], "<3>", 2),
        (["run", "--config", "absent.toml"], "<3>", 2),
        (["describe", "settings", "--check", "--source", "/dev/video77"], "<4>", 0),
    ],
)
def test_lines_of_commands_have_priorities(
    arguments: list[str], priority: str, expected: int, tmp_path: Path
) -> None:
    code, lines = journal_of([sys.executable, "-m", "companion.cli", *arguments], tmp_path)
    assert code == expected
    assert lines
    assert {line[:3] for line in lines} == {priority}
