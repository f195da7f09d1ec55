"""Runs commands of a document as a reader does: one after the other, as printed, in the present folder.

A command that keeps running has a terminal of its own until another of its kind starts, until a command that
needs its end comes, or until the page ends; then it gets a Ctrl-C. `python -m tests.page_commands COMMAND…`
prints each that failed.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress

from tests.companion.service_process import ServiceProcess

# How a command that keeps running starts (a pattern), its kind (one of a kind runs), what its command line
# has, and what it prints when the next command can be given ("": anything).
KEPT = (
    ("companion play", "service", "", "Ctrl-C ends it"),
    ("companion run", "service", "shm://", "up: autopilot"),
    ('companion run --source "udp://', "service", "", "ready: commands on"),
    ("companion run", "service", "udpin://", "up: autopilot"),
    ("companion run", "service", "", "ready: commands on"),
    ("companion view --connect", "dashboard", "", ""),
    ("companion view", "service", "", "up: camera"),
    ("ffmpeg ", "service", "| companion run", "perception running"),
    ("companion mcp --listen", "tools", "", "mcp: http://"),
    ("mavlink-sim --", "vehicle", "--camera", "is on"),
    ("mavlink-sim( --|$)", "vehicle", "", ""),
    ("mavlink-sim camera", "camera", "", "ready: "),
    ("tensorboard", "tensorboard", "", "TensorBoard"),
)
AFTER_FLIGHT = ("companion log replay", "companion learn collect")  # the page ends the service before
PRINTS = (  # without end
    "companion echo",
    "companion status --watch",
    "companion detect shm://front --model none --level",
    "companion detect shm://front --model none --markers",
)
WATCHED = (  # flies long: other tests fly
    'companion ask "find ',
    'companion send "goto ',
    "companion send --vehicle-name vehicle2 'formation ",
)
TAKEN = "command: "  # the service's line for a command
QUESTION, ANSWER = "fly this? [y/N]", b"y\n"
ASKS = 'companion ask "'
COMMAND_S = 120.0
ENDED = (0, 128 + signal.SIGINT)
DIFFERS = ("companion log replay", "companion doctor")  # with exit code 1
OTHERS = "tensorboard"  # not our program: how it ends is not ours to test


def open_terminal(line: str) -> ServiceProcess:
    return ServiceProcess(
        subprocess.Popen(
            ["bash", "-c", line],
            stdin=subprocess.PIPE if line.startswith(ASKS) else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        ),
        "",
    )


def interrupt(terminal: ServiceProcess) -> int:
    """Press Ctrl-C; returns the exit code."""
    if terminal.process.poll() is None:
        os.killpg(terminal.pid, signal.SIGINT)
    return terminal.process.wait(60.0)


def answer(terminal: ServiceProcess) -> None:
    """Wait for the question, if there is one, and answer it."""
    stdin = terminal.process.stdin
    assert stdin is not None
    with suppress(TimeoutError, BrokenPipeError):
        terminal.wait_for_line(QUESTION, COMMAND_S)
        stdin.write(ANSWER)
        stdin.flush()


def failures(lines: Sequence[str]) -> Iterator[str]:
    """Run the commands in order; yields a report of each that fails."""
    kept: dict[str, tuple[str, ServiceProcess]] = {}

    def end(kind: str) -> Iterator[str]:
        if kind in kept:
            line, terminal = kept.pop(kind)
            if (code := interrupt(terminal)) not in ENDED and not line.startswith(OTHERS):
                yield report(line, f"exit code {code} after Ctrl-C", terminal)

    for line in lines:
        for start, kind, part, ready in KEPT:
            if re.match(start, line) and part in line:
                yield from end(kind)
                terminal = open_terminal(line)
                kept[kind] = line, terminal
                try:
                    terminal.wait_for_line(ready, 60.0)
                except TimeoutError:
                    yield report(line, "not ready", terminal)
                break
        else:
            watched = line.startswith(WATCHED)
            if line.startswith(AFTER_FLIGHT):
                yield from end("service")
            if watched:
                _, service = kept["service"]
                service.last_lines()
                before = len(service.lines)
            terminal = open_terminal(line)
            if line.startswith(ASKS) and "--language-may" not in line:
                answer(terminal)
            if line.startswith(PRINTS):
                try:
                    terminal.wait_for_line("", COMMAND_S)
                except TimeoutError:
                    yield report(line, "prints nothing", terminal)
                interrupt(terminal)
                continue
            if watched:
                try:
                    service.wait_for_line(TAKEN, COMMAND_S, after=before)
                except TimeoutError:
                    yield report(line, "no command of the service", service)
                interrupt(terminal)
                continue
            try:
                code = terminal.process.wait(COMMAND_S)
            except subprocess.TimeoutExpired:
                interrupt(terminal)
                yield report(line, "did not end", terminal)
            else:
                if code != 0 and not (code == 1 and line.startswith(DIFFERS)):
                    yield report(line, f"exit code {code}", terminal)
    for kind in list(kept):
        yield from end(kind)


def report(line: str, what: str, terminal: ServiceProcess) -> str:
    return "\n  ".join([f"{line}: {what}", *terminal.last_lines()[-10:]])


if __name__ == "__main__":
    for failure in failures(sys.argv[1:]):
        print(failure, flush=True)
