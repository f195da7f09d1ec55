"""The page as a process: started, refused, and ended with its parent."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from companion.dashboard.server import NICENESS
from companion.host.passing import EXIT_PASSING
from mavlink_sim.testing import free_port
from tests.companion.command_line import companion, companion_here
from tests.companion.dashboard.serving import dashboard_command
from tests.companion.service_process import ServiceProcess
from tests.companion.simulation.test_play import descendants

pytestmark = pytest.mark.realtime


def until_refused(port: int, timeout_s: float = 15.0) -> bool:
    """Wait until nothing listens on a port."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)):
                return True
        time.sleep(0.05)
    return False


def test_dashboard_imports_neither_torch_nor_opencv() -> None:
    code = "import companion.dashboard.__main__, sys; print(sorted({'torch', 'cv2'} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"


def test_command_serves_and_ends_on_ctrl_c(tmp_path: Path) -> None:
    with dashboard_command("tcp/127.0.0.1:9", tmp_path) as url:
        with urllib.request.urlopen(url, timeout=10) as response:
            assert response.status == 200
        address = url.removeprefix("http://").strip("/")
        busy = companion("view", "--connect", "tcp/127.0.0.1:9", "--dashboard-listen", address, cwd=tmp_path)
        assert busy.returncode == EXIT_PASSING
        (line,) = busy.stderr.splitlines()
        assert address in line
        assert " --dashboard-listen " in line


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--dashboard-listen", "0.0.0.0:8088"), "dashboard.token_file"),
        (("--dashboard-listen", "127.0.0.1:99999"), "99999"),
        (("--dashboard-listen", "nonsense"), "HOST:PORT"),
        (("--dashboard-listen", ""), "dashboard.listen"),
        (("--dashboard-listen", "8088"), "dashboard.listen"),
        (("--dashboard-token-file", "missing.txt"), "dashboard.token_file"),
    ],
)
@pytest.mark.timeout(20)  # an option that is not refused starts a server here
def test_bad_options_are_refused_in_one_line(
    tmp_path: Path, flags: tuple[str, ...], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.nice", lambda _: 0)  # this process keeps its priority
    done = companion_here("view", "--connect", "tcp/127.0.0.1:9", *flags, cwd=tmp_path)
    assert done.returncode == 2, done.stdout
    (line,) = done.stderr.splitlines()
    assert named in line


PARENT = """
import asyncio, sys
from companion.dashboard.process import dashboard_process
from companion.settings.settings import Settings

async def main():
    settings = Settings.model_validate({"dashboard": {"listen": sys.argv[1]}})
    async with dashboard_process(settings, lambda line: print(line, flush=True)):
        await asyncio.sleep(600)

asyncio.run(main())
"""


def test_child_has_lower_priority_and_ends_with_a_killed_parent() -> None:
    port = free_port(socket.SOCK_STREAM)
    process = subprocess.Popen(
        [sys.executable, "-c", PARENT, f"127.0.0.1:{port}"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    running = ServiceProcess(process, "")
    try:
        running.wait_for_line(f"dashboard: http://127.0.0.1:{port}/", 60.0)
        (child,) = descendants(process.pid)
        own = os.getpriority(os.PRIO_PROCESS, 0)
        assert os.getpriority(os.PRIO_PROCESS, child) == min(own + NICENESS, 19)
        os.kill(process.pid, signal.SIGKILL)
        assert until_refused(port)
    finally:
        running.stop()
        assert process.stdout is not None
        process.stdout.close()


def test_child_whose_port_is_in_use_reports_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        process = subprocess.Popen(
            [sys.executable, "-c", PARENT, f"127.0.0.1:{port}"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        running = ServiceProcess(process, "")
        try:
            line = running.wait_for_line(f"127.0.0.1:{port}", 60.0)
            assert " --dashboard-listen " in line
            with pytest.raises(TimeoutError):
                running.wait_for_line("dashboard", 3.0, after=len(running.lines))
            assert process.poll() is None
            assert len(running.lines) == 1
        finally:
            running.stop()
            assert process.stdout is not None
            process.stdout.close()
