"""The commands of a page run as printed and in order, in one empty folder: no file, no vehicle, no network.

What does not run here is in `NOT_RUN` or `PAGES_NOT_RUN`, each with its reason.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_docs import DOCUMENTS, ROOT, shell_lines

PRIVATE = (
    "unshare",
    "--map-root-user",
    "--net",
    "--mount",
    "--pid",
    "--fork",
    "--kill-child",
    "--mount-proc",
)
SETUP = 'ip link set lo up && mount -t tmpfs none /dev/shm && exec "$@"'

NOT_RUN = {
    "/dev/video": "a camera",
    "/dev/v4l/": "a camera",
    "csi://0": "a camera",
    "companion calibrate photos": "photographs of a printed board",
    "companion calibrate extrinsics colour": "images of two cameras",
    "companion markers images/": "photographs of a marker",
    "companion view video.mp4": "the reader's video",
    "companion play --vehicles 4": "four rendered cameras",
    "ssh ": "another computer",
    "mavlink-sim --scene field.toml": "the reader's scene",
    "--frames 500": "renders for 15 s",
    "--frames 2000": "renders for 70 s",
    "pip install": "a download",
    "--language-model": "a language model",
    "14_16_02.ulg": "a log that PX4 wrote",
}
PAGES_NOT_RUN = {
    "README.md": "make, pip; images, video and a SITL of the reader",
    "CONTRIBUTING.md": "make runs the tests",
    "formation.md": "a fleet and a benchmark",
    "campaigns.md": "a Ray cluster",
    "environments.md": "compiles the simulator",
    "install.md": "pip and downloads",
    "plug-ins.md": "pip installs the examples",
    "policies.md": "trains two million steps",
    "sitl.md": "an autopilot's SITL",
    "systemd.md": "a board with systemd",
    "train.md": "photographs, and hours of training",
    "zenoh-security.md": "the page's configuration files; test_zenoh_security runs them",
    "models.md": "downloads of models, photographs",
    "simulator-differences.md": "a log of a flight",
    "simulator.md": "pip",
}
PAGES = {path.name: path for path in DOCUMENTS if any(shell_lines(path))}


@functools.cache
def private_network() -> bool:
    """Whether processes can be started with ports, shared memory and process ids of their own."""
    try:
        done = subprocess.run([*PRIVATE, "sh", "-c", SETUP, "sh", "true"], capture_output=True, check=False)
    except FileNotFoundError:
        return False
    return done.returncode == 0


def is_run(line: str) -> bool:
    return not any(part in line for part in NOT_RUN)


@pytest.mark.realtime
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", sorted(PAGES.keys() - PAGES_NOT_RUN.keys()))
def test_page_runs_as_printed_and_in_order(name: str, tmp_path: Path) -> None:
    if not private_network():
        pytest.skip("unshare cannot make a network: the pages use the default ports")
    lines = [line for line in shell_lines(PAGES[name]) if is_run(line)]
    assert lines
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("COMPANION_", "XDG_"))}
    places = {
        "HOME": str(tmp_path / "home"),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "PYTHONUNBUFFERED": "1",
    }
    folder = tmp_path / "work"
    folder.mkdir()
    done = subprocess.run(
        [*PRIVATE, "sh", "-c", SETUP, "sh", sys.executable, "-m", "tests.page_commands", *lines],
        cwd=folder,
        env=kept | places,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr


def test_every_reason_not_to_run_a_command_is_used() -> None:
    lines = [line for path in PAGES.values() for line in shell_lines(path)]
    assert not {part for part in NOT_RUN if not any(part in line for line in lines)}
    assert not PAGES_NOT_RUN.keys() - PAGES.keys()
