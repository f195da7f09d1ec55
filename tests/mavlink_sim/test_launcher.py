"""The vehicles of one program as forks of its launcher: their environment and their end."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from mavlink_sim import launching
from mavlink_sim.launching import LaunchedProcess, can_launch, start_simulator
from mavlink_sim.testing import vehicle

ROOT = Path(__file__).parents[2]
# The options of a vehicle without clients.
SILENT = ["--onboard-bind", "0", "--gcs-bind", "0", "--onboard-port", "9", "--gcs-port", "9", "--no-console"]

pytestmark = pytest.mark.skipif(not can_launch(), reason="a launcher takes Linux with pidfd_open")


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
    """Launchers of this test only: they may be killed, or start with other variables."""
    launchers: list[launching._LauncherOfOurs] = []
    monkeypatch.setattr(launching, "_launchers", launchers)
    yield
    for launcher in launchers:
        launcher.close()


def test_vehicles_are_processes_with_one_parent() -> None:
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


def test_vehicle_has_folder_and_environment_of_requester(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with vehicle():
        pass  # the launcher runs since before
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WHO_WANTS_IT", "a test \udcff")
    with vehicle(ready_file="ready.json", camera=f"launcher-{os.getpid()}") as one:
        assert json.loads((tmp_path / "ready.json").read_text())["pid"] == one.pid
        one.wait_for_event("camera")
        # that is a process that has them from it
        children = Path(f"/proc/{one.pid}/task/{one.pid}/children").read_text().split()
        assert children
        for child in children:
            assert b"WHO_WANTS_IT=a test \xff" in Path(f"/proc/{child}/environ").read_bytes()


def test_failed_start_reports_and_has_exit_code() -> None:
    with start_simulator([*SILENT, "--wind", "99"]) as process:
        assert process.stdout is not None
        assert process.stdout.read() == "mavlink-sim: --wind 99: expected 0 to 8\n"
        assert process.wait(20.0) == 2
        process.terminate()  # it is gone: nothing to do
        assert process.poll() == 2


def test_wait_respects_timeout() -> None:
    with start_simulator(SILENT) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready: ")
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.01)
        assert process.poll() is None
        process.terminate()
        assert process.wait(20.0) == 0


KILL = "os.kill(os.getpid(), signal.SIGKILL)"
HOW_IT_ENDS = {
    "killed": KILL,
    "killed, and its launcher before it": f"os.kill(launcher, signal.SIGKILL); {KILL}",
    "killed, but for a fork of it": f"os.fork() or os._exit(len(os.read(0, 1))); {KILL}",
    "in order, with vehicles in flight": "pass",
}


@pytest.mark.parametrize("how", HOW_IT_ENDS)
def test_vehicles_end_with_their_program(how: str) -> None:
    code = (
        "import os, signal, time; from mavlink_sim.testing import vehicle\n"
        "starting = vehicle(), vehicle(); one, other = (each.__enter__() for each in starting)\n"
        "other.suspend()\n"
        "with open(f'/proc/{one.pid}/stat') as file: launcher = int(file.read().split()[3])\n"
        "assert one.process.poll() is other.process.poll() is None\n"
        f"print(one.pid, other.pid, launcher, flush=True); {HOW_IT_ENDS[how]}"
    )
    command, pipe = [sys.executable, "-c", code], subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True) as program:
        assert program.stdout is not None
        one, other, launcher = map(int, program.stdout.readline().split())
        assert ends(launcher)
        assert ends(one)
        if "launcher" in how:  # a suspended one, whose launcher could not wake it
            os.kill(other, signal.SIGCONT)
        assert ends(other)


@pytest.mark.usefixtures("own_launchers")
def test_vehicle_ends_with_launcher_next_has_new_one() -> None:
    with start_simulator(SILENT) as process:
        assert isinstance(process, LaunchedProcess)
        assert process.stdout.readline().startswith("ready: ")
        launcher = parent_of(process.pid)
        os.kill(launcher, signal.SIGKILL)
        assert process.wait(20.0) == -signal.SIGTERM
        assert process.stdout.read().endswith("stopped\n")  # in order, all the same
        with vehicle() as other:
            assert parent_of(other.pid) != launcher
        assert other.process.returncode == 0
        process.kill()  # it is gone: nothing to do
    assert process.poll() == -signal.SIGTERM


def test_threads_start_vehicles_concurrently() -> None:
    with ThreadPoolExecutor(4) as threads:
        started = list(threads.map(lambda _: start_simulator(SILENT), range(8)))
    assert len({process.pid for process in started}) == 8
    for process in started:
        with process:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ready: ")
            process.terminate()
            assert process.wait(20.0) == 0


def test_too_large_request_starts_without_launcher(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HALF_A_MEGABYTE_1", "x" * 100_000)
    for number in range(2, 6):
        monkeypatch.setenv(f"HALF_A_MEGABYTE_{number}", "x" * 100_000)
    with vehicle() as one:
        assert isinstance(one.process, subprocess.Popen)
    assert one.process.returncode == 0


def test_invalid_request_does_not_affect_others() -> None:
    with vehicle() as one:
        launcher = launching._launcher()
        launcher._requests.send(b"what?")
        with vehicle() as other:
            assert parent_of(one.pid) == parent_of(other.pid)
        assert one.process.poll() is None


def test_expired_timeout_returns_at_once() -> None:
    with vehicle() as one, pytest.raises(subprocess.TimeoutExpired):
        one.process.wait(-1.0)


@pytest.mark.usefixtures("own_launchers")
def test_python_variables_apply_to_next_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    with vehicle() as one:
        monkeypatch.setenv("PYTHONUNBUFFERED", "1" if os.environ.get("PYTHONUNBUFFERED") == "" else "")
        with vehicle() as other:
            assert parent_of(one.pid) != parent_of(other.pid)
            assert one.process.poll() is None
    assert [one.process.returncode, other.process.returncode] == [0, 0]


@pytest.mark.usefixtures("own_launchers")
def test_launcher_failure_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "mavlink_sim").mkdir()
    (tmp_path / "mavlink_sim" / "__init__.py").write_text("raise SystemExit(7)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OSError, match="the launcher of mavlink-sim ended with code 7"):
        start_simulator(SILENT)


def test_without_pidfd_vehicles_start_directly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(os, "pidfd_open")
    with vehicle() as one:
        assert isinstance(one.process, subprocess.Popen)
        assert parent_of(one.pid) == os.getpid()
    assert one.process.returncode == 0
