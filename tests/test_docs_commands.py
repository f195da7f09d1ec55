"""The commands of a page run as printed and in order, in one folder: no vehicle, no network.

What does not run here is in `NOT_RUN`, each with its reason. Files of the reader that a
command names are there (`page_files.GIVEN`).
"""

from __future__ import annotations

import functools
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.settings.layers import SYSTEM_VARIABLE
from tests.page_files import put_files, put_quick_programs
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
    "companion calibrate colour": "images of two cameras",
    "companion detect images/": "photographs of a marker",
    "mosquitto_sub ": "a client of MQTT; tests/companion/mqtt has one",
    "ffplay ": "a window; tests/companion/ground_station plays the video",
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
    "--language-model": "a language model",
    "install mavlink-companion": "downloads",
    "install 'mavlink-companion": "downloads",
    "install --no-compile mavlink-companion": "downloads",
    "install --no-deps mavlink-companion": "downloads",
    "install numpy pymavlink typer": "downloads",
    "companion models pull": "downloads",
    "companion init": "serial lines of this computer; test_init_command has a simulated one",
    "sudo ": "a board with systemd",
    "companion signing": "an autopilot by USB; test_signing_setup has simulated ones",
    "/opt/companion/current": "a board with systemd",
    "make test": "this test",
    "make programs": "a download",
    "make lint": "minutes, for all files",
    "make format": "changes the files",
    "ros2 ": "a ROS 2; tests/companion/ros2 has one",
    "/opt/ros/": "a ROS 2",
    "run --config companion.toml": "a camera of ROS 2",
    "ray ": "a Ray cluster",
    "--ray ": "a Ray cluster",
    "pytest -m sitl": "flights of 15 minutes",
    "--policy": "trains for minutes",
    "FLIGHT.tlog": "a log of a flight; test_recorded_flight has one",
    'send "seek car"': "needs detections, which are late on a busy machine",
    "policy my_approach.onnx": "needs detections, as above",
    "bench detector": "measures for minutes",
    "benchmarks/bundled_model.py": "renders 2,000 frames",
    "benchmarks.environments": "measures for minutes, compiled code",
    "tools.compile_simulator": "compiles for 15 s; test_compile_simulator does",
}
# What takes minutes or hours as printed, and what is run instead.
SHORTENED = {
    "--frames 900": "--frames 12",
    "learn train --data drones": "learn train --steps 2 --batch-size 2 --image-size 96 --data drones",
}


def copy_from_page(path: Path) -> None:
    """The file that zenoh-security.md prints below its name."""
    page = PAGES["zenoh-security.md"].read_text()
    found = re.search(rf"^`{re.escape(path.name)}`:\n\n```\w+\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert found is not None, path.name
    path.write_text(found[1])


# Files whose content a page prints.
PRINTED = {"zenoh-security.md": ("vehicle1.json5", "companion.toml", "operator.json5")}
# Commands of other pages too, which come before what is not run here.
REPEATED = {"policies.md": ("companion play", "companion send")}
# A page with one of these has the programs of `put_quick_programs`; the others, and SLOW, the installed ones.
QUICK = ("companion play", "takeoff", "--camera")
# What the reader has running beforehand: in place of an autopilot's SITL the simulated vehicle.
RUNNING = {
    "boards.md": ("mavlink-sim",),
    "sitl.md": ("mavlink-sim",),
    "systemd.md": ("companion run --source none --vehicle-url none",),
    "troubleshooting.md": (
        "mavlink-sim",
        "companion run --source none --vehicle-url udpin://127.0.0.1:14540",
    ),
}
# More than 40 s of processor time; or no command that runs nowhere else: test_options_of_sources has the
# options of point-clouds.md, avoid.md its flight.
SLOW = {"calibrate.md", "cameras.md", "models.md", "point-clouds.md", "record-and-replay.md", "train.md"}


def run_lines(page: Path) -> Iterator[str]:
    for line in shell_lines(page):
        if not any(part in line for part in (*NOT_RUN, *REPEATED.get(page.name, ()))):
            for part, shorter in SHORTENED.items():
                line = line.replace(part, shorter)
            yield line


PAGES = {path.name: path for path in DOCUMENTS if any(shell_lines(path))}
RUN = sorted(name for name, path in PAGES.items() if any(run_lines(path)))


@functools.cache
def private_network() -> bool:
    """Whether processes can be started with ports, shared memory and process ids of their own."""
    try:
        done = subprocess.run([*PRIVATE, "sh", "-c", SETUP, "sh", "true"], capture_output=True, check=False)
    except FileNotFoundError:
        return False
    return done.returncode == 0


@pytest.mark.realtime
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in RUN]
)
def test_page_runs_as_printed_and_in_order(name: str, tmp_path: Path) -> None:
    if not private_network():
        pytest.skip("unshare cannot make a network: the pages use the default ports")
    lines = [*RUNNING.get(name, ()), *run_lines(PAGES[name])]
    programs = (tmp_path / "quick", Path(sys.executable).parent, os.environ["PATH"], tmp_path / "work/bin")
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("COMPANION_", "XDG_"))}
    places = {
        "HOME": str(tmp_path / "home"),
        SYSTEM_VARIABLE: str(tmp_path / "system.toml"),
        "PATH": os.pathsep.join(map(str, programs)),
        "PYTHONPATH": f"{tmp_path / 'site'}:{ROOT}",
        "PYTHONUNBUFFERED": "1",
        # Of the examples; nothing else can be installed here.
        "PIP_TARGET": str(tmp_path / "site"),
        "PIP_NO_INDEX": "1",
        "PIP_NO_DEPS": "1",
        "PIP_NO_BUILD_ISOLATION": "0",  # the values mean the opposite
    }
    folder = tmp_path / "work"
    folder.mkdir()
    put_files(tuple(shell_lines(PAGES[name])), folder, tmp_path / "home")
    if name not in SLOW and any(part in line for line in lines for part in QUICK):
        put_quick_programs(tmp_path / "quick")
    for file in PRINTED.get(name, ()):
        copy_from_page(folder / file)
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
    assert not (PRINTED.keys() | REPEATED.keys() | RUNNING.keys() | SLOW) - PAGES.keys()
