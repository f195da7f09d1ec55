"""Programs beside the service: how they end."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from companion.host import child_process, restarts
from companion.host.passing import EXIT_PASSING

pytestmark = pytest.mark.realtime

WAITING = "print('ready', flush=True); import sys; sys.stdin.read(); open({path!r}, 'w').write('ended')"
HANGING = "print('ready', flush=True); import time; time.sleep(600)"


def run(module: str, end_s: float = 30.0) -> list[str]:
    """Run a program until it is ready, then end it; returns what was said."""
    said: list[str] = []

    async def until_ready() -> None:
        ready = asyncio.Event()

        def say(line: str) -> None:
            said.append(line)
            ready.set()

        async with child_process.child_process("program", module, "{}", say, end_s=end_s):
            await ready.wait()

    asyncio.run(until_ready())
    return said


def test_program_ends_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    ended = tmp_path / "ended"
    (tmp_path / "waiting_program.py").write_text(WAITING.format(path=str(ended)))
    assert run("waiting_program") == ["program: ready"]
    assert ended.read_text() == "ended"


def test_program_that_does_not_end_is_killed_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(child_process, "_UNSAID_S", 0.1)
    (tmp_path / "hanging_program.py").write_text(HANGING)
    ready, warned, killed = run("hanging_program", 0.2)
    assert ready == "program: ready"
    assert warned.startswith("program: has ")
    assert warned.endswith(" 0.1 s")
    assert killed.startswith("program: did ")
    assert killed.endswith("within 0.2 s; killed")


DYING = """
import pathlib, sys
count = pathlib.Path({path!r})
number = int(count.read_text()) + 1 if count.exists() else 1
count.write_text(str(number))
if number <= 7:
    sys.exit(3)
print("ready", flush=True)
sys.stdin.read()
"""


def test_program_is_started_again_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(restarts, "SOON_S", (0.01,) * 5)
    monkeypatch.setattr(restarts, "LATER_S", 0.02)
    (tmp_path / "dying_program.py").write_text(DYING.format(path=str(tmp_path / "count")))
    said: list[str] = []

    async def until_ready() -> None:
        ready = asyncio.Event()

        def say(line: str) -> None:
            said.append(line)
            if line == "program: ready":
                ready.set()

        async with child_process.child_process("program", "dying_program", "{}", say):
            await ready.wait()

    asyncio.run(until_ready())
    assert [line.split("; ")[1] for line in said[:-1]] == [
        *(f"restarting ({count} of 5)" for count in range(1, 6)),
        "tried again every 0.02 s, 6 failures so far",  # and the same reason again is not said
    ]


@pytest.mark.parametrize(("code", "again"), [(EXIT_PASSING, True), (child_process.EXIT_REFUSED, False)])
def test_reason_that_may_pass_is_said_once_and_tried_again(
    code: int, again: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(child_process, "LATER_S", 0.01)
    (tmp_path / "refusing_program.py").write_text(f"import sys; print('port 1 is taken'); sys.exit({code})")
    said: list[str] = []
    ends: list[tuple[str, bool]] = []

    async def until_ended() -> None:
        enough = asyncio.Event()

        def on_end(why: str, is_again: bool) -> None:
            ends.append((why, is_again))
            if len(ends) == (3 if again else 1):
                enough.set()

        async with child_process.child_process(
            "program", "refusing_program", "{}", said.append, on_end=on_end
        ):
            await enough.wait()

    asyncio.run(until_ended())
    assert said == ["program: port 1 is taken"]
    assert ends[0] == ("port 1 is taken", again)
