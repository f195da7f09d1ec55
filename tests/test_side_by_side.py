"""`make test` runs everything, tells all of it, and leaves nothing behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests import late_workers

ROOT = Path(__file__).parent.parent
# Instead of pytest: says which part it was given, and ends, or waits, as the part's variable says.
STAND_IN = """
import os, signal, subprocess, sys
part = "beside" if "not clocked" in sys.argv else "clocked" if "clocked" in sys.argv else "alone"
watched = "watched" if os.environ["COMPANION_TEST_STANDSTILLS"] else "unwatched"
late = "with" if "COMPANION_TEST_LATE_WORKERS" in os.environ else "without"
print(part, "at niceness", os.nice(0), watched, late, "late workers", flush=True)
what = os.environ.get(part, "0")
if what == "waits":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"]) as child:
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            print(os.getpid(), flush=True)
            child.wait()
        finally:
            child.kill()
sys.exit(int(what))
"""
RUN = """
import sys
from tests import side_by_side
side_by_side.PYTEST = [sys.executable, sys.argv[1]]
sys.exit(side_by_side.main(3))
"""


def started(tmp_path: Path, **parts: str) -> subprocess.Popen[str]:
    stand_in = tmp_path / "stand_in.py"
    stand_in.write_text(STAND_IN)
    return subprocess.Popen(
        [sys.executable, "-c", RUN, str(stand_in)],
        cwd=ROOT,
        env={**os.environ, **parts},
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def is_gone(group: int, within_s: float = 20.0) -> bool:
    """Whether no process of a group is left, at once or when the last that was killed has been buried."""
    until_s = time.monotonic() + within_s
    while time.monotonic() < until_s:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


@pytest.mark.parametrize(
    ("parts", "code"),
    [
        ({}, 0),
        ({"alone": "1"}, 1),
        ({"clocked": "2"}, 2),
        ({"beside": "3"}, 3),
        ({"clocked": "2", "beside": "3"}, 2),
    ],
)
def test_everything_runs_whatever_fails_and_what_computes_is_told_last(
    tmp_path: Path, parts: dict[str, str], code: int
) -> None:
    with started(tmp_path, **parts) as running:
        said, _ = running.communicate(timeout=60)
    assert running.returncode == code
    first_words = [line.split()[0] for line in said.splitlines() if line and "beside these" not in line]
    assert first_words == ["alone", "clocked", "beside", "not" if parts else "all"]
    names = {"alone": "the demonstration", "clocked": "by the clock", "beside": "what computes"}
    verdict = said.splitlines()[-1]
    assert all((name in verdict) == (part in parts) for part, name in names.items())
    assert "beside at niceness 19 watched without late workers" in said
    assert f"clocked at niceness {os.nice(0)} watched with late workers" in said


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_who_ends_it_ends_all_of_it(tmp_path: Path, number: int, code: int) -> None:
    with started(tmp_path, clocked="waits", beside="waits") as running:
        assert running.stdout is not None
        assert running.stdout.readline().startswith("alone")
        assert running.stdout.readline().startswith("clocked")
        waiting = int(running.stdout.readline())
        os.killpg(running.pid, number) if number == signal.SIGINT else running.send_signal(number)
        assert running.wait(60) == code
    with pytest.raises(ProcessLookupError):
        os.kill(waiting, 0)
    assert is_gone(running.pid)


FLIGHTS = """
import os, threading, time
import pytest

@pytest.mark.parametrize("number", range(8))
def test_flight(number):
    waits = [thread.name for thread in threading.enumerate() if thread.name.startswith("waits for")]
    assert len(waits) == len(set(waits))
    with open("flown", "a") as flown:
        print(os.environ["PYTEST_XDIST_WORKER"], file=flown)
    with open("flown") as flown:
        sixth = len(flown.readlines()) == 6
    while sixth and not os.path.exists("landing"):
        time.sleep(0.01)
"""


@pytest.mark.parametrize("ends_first", ["what computes", "the early worker's tests"])
def test_a_late_worker_begins_when_one_that_it_waits_for_has_ended(tmp_path: Path, ends_first: str) -> None:
    (tmp_path / "test_flights.py").write_text(FLIGHTS)
    flown, landing = tmp_path / "flown", tmp_path / "landing"
    held = late_workers.held(tmp_path / late_workers.COMPUTES)
    command = [sys.executable, "-m", "pytest", "-p", "tests.late_workers", "-n", "2", "--dist", "worksteal"]
    environment = {"PYTHONPATH": str(ROOT), late_workers.LATE_WORKERS: late_workers.told(1, 1, tmp_path)}
    with (
        subprocess.Popen(["sleep", "100"], pass_fds=[held.fileno()]) as computing,
        subprocess.Popen(command, cwd=tmp_path, env={**os.environ, **environment}) as running,
    ):
        held.close()
        try:
            # The late one keeps what it waits with and one more; the other takes the rest from it.
            until(lambda: flown.exists() and flown.read_text().count("\n") == 6)
            assert set(flown.read_text().split()) == {"gw0"}
            if ends_first == "what computes":
                computing.kill()
                until(lambda: flown.read_text().count("\n") == 8)
            landing.touch()
            assert running.wait(60) == 0
        finally:
            computing.kill()
            running.kill()
    assert flown.read_text().split() == ["gw0"] * 6 + ["gw1"] * 2


def until(true: Callable[[], bool], within_s: float = 60.0) -> None:
    """Raises AssertionError if it does not become true in time."""
    until_s = time.monotonic() + within_s
    while not true():
        assert time.monotonic() < until_s
        time.sleep(0.01)
