"""The commands of a page run as printed and in order, in one folder: no vehicle, no network,
no file but what the reader has (`GIVEN`).

What does not run here is in `NOT_RUN` or `PAGES_NOT_RUN`, each with its reason.
"""

from __future__ import annotations

import functools
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
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
    "--pull": "a download",
    "--from yolov8n": "a download, and photographs",
    "--most 50": "a service on another computer",
    "follow drone": "two steps of training do not teach a class",
    "yolox_s": "a download",
    "make ": "makes an environment, flies the demonstration, runs the tests",
    "companion play --vehicles 4": "four rendered cameras",
    "ssh ": "another computer",
    "mavlink-sim --scene field.toml": "the reader's scene",
    "--frames 500": "renders for 15 s",
    "--frames 2000": "renders for 70 s",
    "pip install": "a download",
    "--language-model": "a language model",
    "14_16_02.ulg": "a log that PX4 wrote",
}
# What takes minutes or hours as printed, and what is run instead.
SHORTENED = {
    "--frames 900": "--frames 12",
    "companion train --data drones": "companion train --steps 2 --batch-size 2 --image-size 96 --data drones",
}
PAGES_NOT_RUN = {
    "CONTRIBUTING.md": "make runs the tests",
    "campaigns.md": "a Ray cluster",
    "environments.md": "compiles the simulator",
    "install.md": "pip and downloads",
    "plug-ins.md": "pip installs the examples",
    "policies.md": "trains two million steps",
    "sitl.md": "an autopilot's SITL",
    "systemd.md": "a board with systemd",
    "models.md": "downloads of models, photographs",
    "simulator-differences.md": "a log of a flight",
    "simulator.md": "pip",
}


def draw_photo(path: Path) -> None:
    shutil.copy(ROOT / "docs/images/demo.png", path)


def draw_video(path: Path) -> None:
    """Two seconds of the size that README's pipe states."""
    image = cv2.resize(np.asarray(cv2.imread(str(ROOT / "docs/images/demo.png"))), (640, 272))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (640, 272))
    for _ in range(40):
        writer.write(image)
    writer.release()


def write_decoder(path: Path) -> None:
    """Stand in for README's ffmpeg where there is none; it does not wait between frames, as `-re` does."""
    path.write_text(
        f"#!{sys.executable}\nimport cv2, sys\nvideo = cv2.VideoCapture(sys.argv[sys.argv.index('-i') + 1])\n"
        "while (read := video.read())[0]:\n    sys.stdout.buffer.write(read[1].tobytes())\n"
    )
    path.chmod(0o755)


def copy_from_page(path: Path) -> None:
    """The file that zenoh-security.md prints below its name."""
    page = PAGES["zenoh-security.md"].read_text()
    found = re.search(rf"^`{re.escape(path.name)}`:\n\n```\w+\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert found is not None, path.name
    path.write_text(found[1])


# What the reader has, as the page says, and what makes it here. Programs are in bin/.
GIVEN: dict[str, dict[str, Callable[[Path], None]]] = {
    "README.md": {"video.mp4": draw_video, "photos/1.png": draw_photo, "bin/ffmpeg": write_decoder},
    "dashboard.md": {"video.mp4": draw_video},
    "zenoh-security.md": dict.fromkeys(
        ("vehicle1.json5", "companion.toml", "operator.json5"), copy_from_page
    ),
}
# More than 40 s of processor time.
SLOW = {"cameras.md", "record-and-replay.md", "train.md"}
PAGES = {path.name: path for path in DOCUMENTS if any(shell_lines(path))}


@functools.cache
def private_network() -> bool:
    """Whether processes can be started with ports, shared memory and process ids of their own."""
    try:
        done = subprocess.run([*PRIVATE, "sh", "-c", SETUP, "sh", "true"], capture_output=True, check=False)
    except FileNotFoundError:
        return False
    return done.returncode == 0


def run_lines(page: Path) -> Iterator[str]:
    for line in shell_lines(page):
        if not any(part in line for part in NOT_RUN):
            for part, shorter in SHORTENED.items():
                line = line.replace(part, shorter)
            yield line


@pytest.mark.realtime
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
        for name in sorted(PAGES.keys() - PAGES_NOT_RUN.keys())
    ],
)
def test_page_runs_as_printed_and_in_order(name: str, tmp_path: Path) -> None:
    if not private_network():
        pytest.skip("unshare cannot make a network: the pages use the default ports")
    lines = list(run_lines(PAGES[name]))
    assert lines
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("COMPANION_", "XDG_"))}
    places = {
        "HOME": str(tmp_path / "home"),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}:{tmp_path / 'work/bin'}",
        "PYTHONPATH": str(ROOT),
        "PYTHONUNBUFFERED": "1",
    }
    folder = tmp_path / "work"
    folder.mkdir()
    for file, make in GIVEN.get(name, {}).items():
        (folder / file).parent.mkdir(exist_ok=True)
        make(folder / file)
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
    assert not {part for part in NOT_RUN.keys() | SHORTENED.keys() if not any(part in line for line in lines)}
    assert not (PAGES_NOT_RUN.keys() | GIVEN.keys()) - PAGES.keys()
