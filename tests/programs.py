"""What tests need beyond Python packages. `make programs` installs what can be installed.

A test with `pytest.mark.needs(name)` is left out where that is not here; it fails with
COMPANION_TEST_PROGRAMS=required, as in `.ci/run`. `python -m tests.programs` says in one line what is left
out and how to get it; `python -m tests.programs debian` names the packages of Debian that are missing, and
`python -m tests.programs wheels` the machine if there are wheels of ROS 2 for it.
"""

from __future__ import annotations

import os
import platform
import shutil
import sys
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
REQUIRED = os.environ.get("COMPANION_TEST_PROGRAMS") == "required"
DATA = Path(os.environ.get("COMPANION_TEST_DATA", HERE.parents[1] / "shared" / "data"))
AXE = HERE / "companion" / "dashboard" / "node_modules" / "axe-core" / "axe.min.js"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
NODE = shutil.which("node")
# Debian has them where only root looks.
MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
NGINX = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
# GPL, and its requirements would replace the headless OpenCV: it has an environment of its own.
MAVPROXY = shutil.which("mavproxy.py", path=str(HERE.parent / ".venv-mavproxy" / "bin")) or shutil.which(
    "mavproxy.py"
)
ROS_PYTHONS = {
    name: HERE.parent / f".venv-ros-{name.lower()}" / "bin" / "python" for name in ("Jazzy", "Kilted")
}
"""Release of ROS 2: its Python, with rclpy and the messages of `companion.ros2.definitions`."""
ROS_WHEELS = f"{sys.platform}-{platform.machine()}" == "linux-x86_64" and sys.version_info[:2] <= (3, 13)
ROS_READER = HERE / "companion" / "ros2" / "node_modules" / "@foxglove" / "rosmsg2-serialization"
PYTHON_HEADER = Path(sysconfig.get_path("include"), "Python.h")
# An implementation of rmw_zenoh's wire format; its requirements are of no other use.
PYZEROS = HERE.parent / ".venv-pyzeros" / "bin" / "python"
# Its server with the Python of the system, a player, and their codecs.
GSTREAMER = (
    *("python3-gi", "gir1.2-gst-rtsp-server-1.0", "gstreamer1.0-tools"),
    *(f"gstreamer1.0-plugins-{kind}" for kind in ("base", "good", "bad")),
)
GSTREAMER_FILES = (
    "bin/gst-launch-1.0",
    "lib/python3/dist-packages/gi",
    "lib/*/girepository-1.0/GstRtspServer-1.0.typelib",
    "lib/*/gstreamer-1.0/libgstrtp.so",
    "lib/*/gstreamer-1.0/libgstopenh264.so",
)
# A folder for what `make test-systemd` keeps between two runs.
SYSTEMD = Path(folder) if (folder := os.environ.get("COMPANION_TEST_SYSTEMD")) else None
# To make and boot a container of Debian, as root.
CONTAINER = ("debootstrap", "systemd-nspawn", "nsenter", "apt-get")
COMPILER = (sysconfig.get_config_var("CC") or "cc").split()[0]

MAKE = "`make programs`, on Debian as root"


class Need(NamedTuple):
    """Something that tests need.

    Attributes:
        here: whether it is here.
        tests: what is left out without it.
        get: how to get it.
        debian: Debian's package with it, or with what installs it.
    """

    here: bool
    tests: str
    get: str = MAKE
    debian: str = ""


def program(name: str, tests: str, debian: str) -> Need:
    return Need(shutil.which(name) is not None, tests, debian=debian)


def ros(release: str) -> Need:
    """A release of ROS 2. Its messages are compiled."""
    return Need(
        ROS_PYTHONS[release].parents[1].joinpath(".installed").is_file(),
        f"messages and nodes of ROS 2 {release}",
        MAKE if ROS_WHEELS else "there are wheels for Linux on x86-64 and Python 3.11 to 3.13",
        debian=" ".join(
            package
            for package, here in (("g++", shutil.which("g++")), ("python3-dev", PYTHON_HEADER.is_file()))
            if ROS_WHEELS and not here
        ),
    )


NEEDS = {
    "chromium": Need(CHROMIUM is not None, "the page in a browser", debian="chromium"),
    "node": program("node", "the page's functions", "nodejs"),
    "axe-core": Need(AXE.is_file(), "the page's accessibility", debian="" if shutil.which("npm") else "npm"),
    "MAVProxy": Need(MAVPROXY is not None, "MAVProxy as a client"),
    "pyzeros": Need(PYZEROS.is_file(), "rmw_zenoh with another implementation"),
    "mosquitto": Need(MOSQUITTO is not None, "MQTT with a broker", debian="mosquitto"),
    "openssl": program("openssl", "zenoh and MQTT with TLS", "openssl"),
    "nginx": Need(NGINX is not None, "the page behind a proxy", debian="nginx-light"),
    "systemd-analyze": program("systemd-analyze", "the exposure of the units", "systemd"),
    "C compiler": program(COMPILER, "the compiled simulator", "gcc"),
    "ROS 2 Jazzy": ros("Jazzy"),
    "ROS 2 Kilted": ros("Kilted"),
    "rosmsg2-serialization": Need(ROS_READER.is_dir(), "messages of ROS 2 as Foxglove reads them"),
    "GStreamer": Need(
        all(any(Path("/usr").glob(pattern)) for pattern in GSTREAMER_FILES),
        "H.264, and video in a player of GStreamer",
        debian=" ".join(GSTREAMER),
    ),
    "mavlink-router": Need(
        shutil.which("mavlink-routerd") is not None, "a real MAVLink router", "docs/boards.md"
    ),
    "systemd container": Need(
        SYSTEMD is not None and os.geteuid() == 0 and all(map(shutil.which, CONTAINER)),
        "install, watchdog, stop and update under systemd",
        "`make test-systemd`, as root, with debootstrap and systemd-container of Debian",
    ),
    "autopilot": Need("COMPANION_SITL_URL" in os.environ, "SITL", "docs/how-to/sitl.md"),
    "test data": Need(DATA.is_dir(), "real flights, photographs and networks", "COMPANION_TEST_DATA"),
}


def left_out(needs: Mapping[str, Need] = NEEDS) -> str:
    """One line on the tests that are left out, and how to get them; empty if none is."""
    missing: dict[str, list[str]] = {}
    for name, need in needs.items():
        if not need.here:
            missing.setdefault(need.get, []).append(f"{need.tests} (no {name})")
    if not missing:
        return ""
    return "left out: " + "; ".join(f"{', '.join(tests)}: {get}" for get, tests in missing.items())


if __name__ == "__main__":
    packages = [need.debian for need in NEEDS.values() if need.debian and not need.here]
    lines = {"debian": " ".join(dict.fromkeys(packages)), "wheels": platform.machine() if ROS_WHEELS else ""}
    if line := lines[sys.argv[1]] if sys.argv[1:] else left_out():
        print(line)
