"""What fails while the computer stands still is run again, and nothing else."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.run_again import NOTES
from tests.standstill import STANDSTILL_S, Watch, longest_standstill_s

PASSES_THE_THIRD_TIME = """
from pathlib import Path

def test_of_something():
    runs = Path("runs")
    with runs.open("a") as output:
        output.write("run\\n")
    assert len(runs.read_text().splitlines()) == {passes_in}
"""


def test_a_processor_that_stands_still_is_noted_with_how_long(tmp_path: Path) -> None:
    watch = Watch(tmp_path / "notes")
    began_ns = time.monotonic_ns()
    try:
        for process in watch.processes:
            os.kill(process.pid, signal.SIGSTOP)
            os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        time.sleep(2 * STANDSTILL_S)  # the standstill itself
    finally:
        for process in watch.processes:
            os.kill(process.pid, signal.SIGCONT)
    while longest_standstill_s(watch.notes, began_ns) < 2 * STANDSTILL_S:
        time.sleep(0.01)
    watch.close()
    assert all(process.returncode == 0 for process in watch.processes)


def test_the_longest_of_those_that_ended_since_counts(tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    notes.write_text("1000000000 3000000000\n3500000000 4000000000\n4000000000 4700000000\n")
    assert longest_standstill_s(notes, 2_000_000_000) == 2.0
    assert longest_standstill_s(notes, 3_000_000_000) == 0.7
    assert longest_standstill_s(notes, 4_700_000_000) == 0.0


@pytest.mark.parametrize(
    ("standstill", "passes_in", "code", "runs"),
    [
        pytest.param(True, 3, 0, 3, id="run again"),
        pytest.param(True, 4, 1, 3, id="run again twice at most"),
        pytest.param(False, 3, 1, 1, id="every other failure stands"),
        pytest.param(True, 1, 0, 1, id="what passed has passed"),
    ],
)
def test_what_failed_in_a_standstill(
    tmp_path: Path, standstill: bool, passes_in: int, code: int, runs: int
) -> None:
    (tmp_path / "test_it.py").write_text(PASSES_THE_THIRD_TIME.format(passes_in=passes_in))
    now_ns = time.monotonic_ns()
    notes = tmp_path / "notes"
    notes.write_text(f"{now_ns} {now_ns + 10**13}\n" if standstill else "")
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "tests.run_again", "-raR", "test_it.py"],
        cwd=tmp_path,
        env=os.environ | {NOTES: str(notes), "PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == code, ended.stdout
    assert len((tmp_path / "runs").read_text().splitlines()) == runs
    assert ended.stdout.count("RERUN") == runs - 1
    assert (f"{runs - 1} run again, for a processor that stood still" in ended.stdout) == (runs > 1)


def test_what_ends_a_worker_is_not_run_again(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(
        "import os\n\ndef test_of_something():\n    open('runs', 'a').write('run\\n')\n    os._exit(3)\n"
    )
    now_ns = time.monotonic_ns()
    (tmp_path / "notes").write_text(f"{now_ns} {now_ns + 10**13}\n")
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "1", "--dist", "worksteal", "-p", "tests.run_again"],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
        | {NOTES: str(tmp_path / "notes"), "PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 1, ended.stdout
    assert "crashed while running" in ended.stdout
    assert (tmp_path / "runs").read_text().splitlines() == ["run"]
