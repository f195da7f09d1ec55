"""Vehicles of one program are forks of one launcher: what they are, how they end, and what ends them."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mavlink_sim import launched as launching
from mavlink_sim.launched import LaunchedProcess, launched
from mavlink_sim.testing import vehicle

ROOT = Path(__file__).parents[2]
# Of a vehicle that nobody speaks to.
ENDS = ["--onboard-bind", "0", "--gcs-bind", "0", "--onboard-port", "9", "--gcs-port", "9", "--no-console"]

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="a launcher takes Linux")


def parent_of(pid: int) -> int:
    stat = Path(f"/proc/{pid}/stat").read_text()
    return int(stat.rpartition(")")[2].split()[1])


def ends(pid: int, timeout_s: float = 20.0) -> bool:
    """Whether a process that is not our own child ends within this time."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([descriptor], [], [], timeout_s)[0])
    finally:
        os.close(descriptor)


@pytest.fixture
def own_launchers(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Launchers of this test alone: they may be killed, or start with other variables."""
    launchers: list[launching._Launcher] = []
    monkeypatch.setattr(launching, "_launchers", launchers)
    yield
    for launcher in launchers:
        launcher.close()


def test_vehicles_of_a_program_are_processes_of_their_own_with_one_parent() -> None:
    with vehicle(system_id=7) as one, vehicle(system_id=8) as other:
        assert one.pid != other.pid
        assert parent_of(one.pid) == parent_of(other.pid)
        assert parent_of(parent_of(one.pid)) == os.getpid()
        assert [one.vehicles[0].system_id, other.vehicles[0].system_id] == [7, 8]
        other.kill()
        assert one.process.poll() is None
        one.fault("wind 3")
        one.wait_for_event("wind 3 begins")
    assert one.process.returncode == 0
    assert other.process.returncode == -signal.SIGKILL


def test_a_vehicle_runs_in_the_folder_and_with_the_variables_of_who_wants_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with vehicle():
        pass  # the launcher runs since before
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WHO_WANTS_IT", "a test \udcff")
    with vehicle(ready_file="ready.json", camera=f"launcher-{os.getpid()}") as one:
        assert json.loads((tmp_path / "ready.json").read_text())["pid"] == one.pid
        # its camera is a process that has them from it
        children = Path(f"/proc/{one.pid}/task/{one.pid}/children").read_text().split()
        assert children
        for child in children:
            assert b"WHO_WANTS_IT=a test \xff" in Path(f"/proc/{child}/environ").read_bytes()


def test_what_cannot_start_says_so_and_has_its_exit_code() -> None:
    with launched([*ENDS, "--wind", "99"]) as process:
        assert process.stdout is not None
        assert process.stdout.read() == "mavlink-sim: --wind 99: expected 0 to 8\n"
        assert process.wait(20.0) == 2
        process.terminate()  # it is gone: nothing to do
        assert process.poll() == 2


def test_waiting_for_one_that_flies_on_takes_no_longer_than_told() -> None:
    with launched(ENDS) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready: ")
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.01)
        assert process.poll() is None
        process.terminate()
        assert process.wait(20.0) == 0


def test_with_the_program_that_started_them_all_vehicles_end() -> None:
    code = (
        "import os, signal, time; from mavlink_sim.testing import vehicle\n"
        "one, other = vehicle().__enter__(), vehicle().__enter__(); other.suspend()\n"
        "print(one.pid, other.pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    pids = [int(word) for word in killed.stdout.split()]
    assert len(pids) == 2
    assert all(ends(pid) for pid in pids)


@pytest.mark.usefixtures("own_launchers")
def test_a_vehicle_outlives_a_launcher_that_is_killed_and_the_next_has_another() -> None:
    unknown = pytest.raises(ChildProcessError, match="has ended; how, only its launcher knew")
    with unknown, launched(ENDS) as process:
        assert isinstance(process, LaunchedProcess)
        assert process.stdout.readline().startswith("ready: ")
        launcher = parent_of(process.pid)
        os.kill(launcher, signal.SIGKILL)
        assert ends(launcher)
        assert process.poll() is None
        with vehicle() as other:
            assert parent_of(other.pid) != launcher
        assert other.process.returncode == 0
        process.terminate()
        assert process.stdout.read() == "stopped\n"


@pytest.mark.usefixtures("own_launchers")
def test_pythons_own_variables_count_from_the_next_vehicle_on(monkeypatch: pytest.MonkeyPatch) -> None:
    with vehicle() as one:
        monkeypatch.setenv("PYTHONUNBUFFERED", "1" if os.environ.get("PYTHONUNBUFFERED") == "" else "")
        with vehicle() as other:
            assert parent_of(one.pid) != parent_of(other.pid)
            assert one.process.poll() is None
    assert [one.process.returncode, other.process.returncode] == [0, 0]


@pytest.mark.usefixtures("own_launchers")
def test_a_launcher_that_ends_at_once_says_how(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "mavlink_sim").mkdir()
    (tmp_path / "mavlink_sim" / "__init__.py").write_text("raise SystemExit(7)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OSError, match="the launcher of mavlink-sim ended with code 7"):
        launched(ENDS)


def test_where_there_are_no_descriptors_of_processes_vehicles_are_started_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(os, "pidfd_open")
    with vehicle() as one:
        assert isinstance(one.process, subprocess.Popen)
        assert parent_of(one.pid) == os.getpid()
    assert one.process.returncode == 0
