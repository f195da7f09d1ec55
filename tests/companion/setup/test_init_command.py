"""`companion init` writes a file with which the service starts, and a second run changes nothing."""

from __future__ import annotations

import errno
import json
import os
import pty
import select
import socket
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from companion.doctor import facts as doctor_facts
from companion.doctor.facts import CameraTrial, Facts, Machine
from companion.doctor.listening import Sender
from companion.settings import Settings, reading
from companion.settings.layers import SYSTEM_VARIABLE, user_file
from companion.settings.reading import ConfigurationError
from companion.setup import autopilots
from companion.setup import init as setup
from companion.setup.autopilots import Autopilot
from companion.setup.cameras import Camera, Candidate
from companion.setup.init import Asking, propose
from companion.setup.settings_file import MARK, merged
from companion.setup.target import Target, read_target
from companion.setup.tried import Tried
from companion.vehicle.link_url import parse_link_url
from mavlink_sim.testing import free_port, running_simulator
from tests.companion.command_line import companion, companion_here
from tests.companion.service_process import START_S, ServiceProcess, heartbeats

PX4 = Sender(2, 12, 2, signed=False)
# Of the doctor's checks those of what init writes.
WRITTEN = {"settings", "heartbeats", "vehicle port", "serial device", "serial permission", "serial line"}
WRITTEN |= {"camera", "camera device", "model"}


@pytest.fixture
def dev(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A /dev without devices: those of the computer that runs the tests stay closed."""
    (folder := tmp_path / "dev" / "pts").mkdir(parents=True)
    monkeypatch.setattr(doctor_facts, "Machine", partial(Machine, dev=folder.parent))
    monkeypatch.setattr(autopilots, "UDP_PORTS", ())
    monkeypatch.setattr(autopilots, "TCP_PORTS", ())
    return folder.parent


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A settings file with ports that are nobody's."""
    path = tmp_path / "companion.toml"
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    path.write_text(f'# mine\n[zenoh]\nlisten = ["{endpoint}"]\n\n[dashboard]\nlisten = ""\n')
    return path


@contextmanager
def service(file: Path) -> Iterator[ServiceProcess]:
    """`companion run` with a file, whose vehicle is connected."""
    (endpoint,) = tomllib.loads(file.read_text())["zenoh"]["listen"]
    command = [sys.executable, "-m", "companion.cli", "run", "--config", str(file)]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("COMPANION_")}
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, cwd=file.parent, env=environment
    )
    running = ServiceProcess(process, endpoint)
    try:
        running.wait_for_line(" up: autopilot", START_S)
        yield running
    except BaseException as error:
        error.add_note("\n".join(running.last_lines()))
        raise
    finally:
        running.stop()
        assert process.stderr is not None
        process.stderr.close()


@contextmanager
def serial_vehicle() -> Iterator[str]:
    """A simulated vehicle at the other end of a serial line; yields the line's device."""
    near, far = pty.openpty()
    device = os.ttyname(far)
    os.close(far)  # a doctor must find it free
    os.set_blocking(near, False)
    ended = threading.Event()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as onboard,
        running_simulator(ready_after=0.0, onboard_port=(port := free_port())) as simulator,
    ):
        onboard.bind(("127.0.0.1", port))
        vehicle = ("127.0.0.1", simulator.onboard_bind)

        def carry() -> None:
            while not ended.is_set():
                for ready in select.select([near, onboard.fileno()], [], [], 0.1)[0]:
                    try:
                        if ready != near:
                            os.write(near, onboard.recv(2000))
                        else:
                            onboard.sendto(os.read(near, 2000), vehicle)
                    except OSError:  # nobody has it open, or reads
                        ended.wait(0.02)

        carrying = threading.Thread(target=carry, name="serial line", daemon=True)
        carrying.start()
        try:
            yield device
        finally:
            ended.set()
            carrying.join()
            os.close(near)


def faults(file: Path) -> list[dict[str, Any]]:
    """What the doctor finds at fault of what init has written."""
    done = companion("doctor", "--json", "--config", file, cwd=file.parent)
    checks = json.loads(done.stdout)
    return [check for check in checks if check["verdict"] == "fault" and check["name"] in WRITTEN]


def twice(file: Path, *arguments: str) -> dict[str, Any]:
    """Run init two times, and return what it has written; the second run changes nothing."""
    done = companion_here("init", "--yes", "--output", file, *arguments, cwd=file.parent)
    assert done.returncode == 0, done.stdout + done.stderr
    files = sorted(file.parent.glob("companion.toml*"))
    text = file.read_text()
    again = companion_here("init", "--yes", "--output", file, *arguments, cwd=file.parent)
    assert again.returncode == 0, again
    assert file.read_text() == text
    assert sorted(file.parent.glob("companion.toml*")) == files
    assert text.startswith("# mine\n")
    return tomllib.loads(text)


@pytest.mark.realtime
def test_service_flies_with_what_was_found_on_udp(
    dev: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = free_port()
    monkeypatch.setattr(autopilots, "UDP_PORTS", (port,))
    with running_simulator(ready_after=0.0, onboard_port=port, system_id=7):
        written = twice(file)
        assert written["vehicle"] == {"url": f"udpin://127.0.0.1:{port}", "system_id": 7}
        assert written["source"] == {"uri": "none"}
        assert faults(file) == []
        with service(file) as running:
            done = companion_here("status", "--connect", running.endpoint, cwd=file.parent)
            assert done.returncode == 0, done.stdout + done.stderr
            text = file.read_text()
            # The running service has the port open, and is asked.
            done = companion_here("init", "--yes", "--output", file, cwd=file.parent)
            assert done.returncode == 0, done.stdout + done.stderr
            assert file.read_text() == text


@pytest.mark.realtime
def test_service_flies_with_what_was_found_on_a_serial_line(dev: Path, file: Path) -> None:
    with serial_vehicle() as device:
        (dev / "pts" / Path(device).name).symlink_to(device)
        written = twice(file, "--serial", device)
        assert written["vehicle"]["url"] == f"serial://{device}:{autopilots.BAUDS[0]}"
        assert faults(file) == []
        with service(file) as running:
            done = companion_here("status", "--connect", running.endpoint, cwd=file.parent)
            assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.realtime
def test_dry_run_writes_nothing(dev: Path, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = file.read_text()
    with heartbeats() as port:
        monkeypatch.setattr(autopilots, "UDP_PORTS", (port,))
        done = companion_here("init", "--yes", "--dry-run", "--output", file, cwd=file.parent)
    assert done.returncode == 0
    assert f'+url = "udpin://127.0.0.1:{port}"' in done.stdout
    assert file.read_text() == before
    assert list(file.parent.glob("companion.toml*")) == [file]


@pytest.mark.realtime
def test_without_an_autopilot_each_place_is_named(
    dev: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = file.read_text()
    port = free_port()
    monkeypatch.setattr(autopilots, "UDP_PORTS", (port,))
    done = companion_here("init", "--yes", "--output", file, "--serial", "/dev/ttyX", cwd=file.parent)
    assert done.returncode == 1
    assert f"UDP port {port}" in done.stdout
    assert "ttyX" in done.stdout
    assert len(done.stderr.splitlines()) == 1
    assert file.read_text() == before


def test_without_a_terminal_and_yes_it_is_refused(tmp_path: Path) -> None:
    done = companion_here("init", "--output", tmp_path / "companion.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "--yes" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_file_with_mistakes_is_not_touched(dev: Path, tmp_path: Path) -> None:
    (path := tmp_path / "companion.toml").write_text("[tracker]\nlost_s = 1.0\n")
    done = companion_here("init", "--yes", "--output", path, cwd=tmp_path)
    assert done.returncode == 2
    assert "tracker.coast_timeout_s" in done.stderr
    assert path.read_text() == "[tracker]\nlost_s = 1.0\n"


def test_file_that_cannot_be_written_is_refused_first(dev: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = companion_here("init", "--yes", "--output", tmp_path / "file" / "a.toml", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")


@pytest.mark.parametrize("name", ["locked/a.toml", "link.toml"])
def test_folder_in_which_nothing_may_be_replaced_is_refused_first(
    dev: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (folder := tmp_path / "locked").mkdir()
    (folder / "a.toml").touch()
    (tmp_path / "link.toml").symlink_to(folder / "a.toml")
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != folder.resolve() and access(path, mode))
    done = companion_here("init", "--yes", "--output", tmp_path / name, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")


@pytest.mark.realtime
def test_next_line_is_for_the_file_that_was_written(
    dev: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = file.rename(file.with_name("my board.toml"))
    with heartbeats() as port:
        monkeypatch.setattr(autopilots, "UDP_PORTS", (port,))
        done = companion_here("init", "--yes", "--output", own, cwd=own.parent)
    assert f"companion run --config '{own}'" in done.stdout.splitlines()[-1]


def test_system_file_that_is_not_readable_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    system = tmp_path / "companion.toml"
    system.touch()
    monkeypatch.setenv(SYSTEM_VARIABLE, str(system))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    stat = os.stat

    def refused(path: str | Path, **options: Any) -> os.stat_result:
        if str(path) == str(system):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, **options)

    monkeypatch.setattr(os, "stat", refused)
    monkeypatch.setattr(reading, "read_text", refused)
    with pytest.raises(ConfigurationError, match="Permission denied"):
        read_target(user_file())


def proposed(
    monkeypatch: pytest.MonkeyPatch,
    target: Target,
    links: Sequence[str] = (),
    cameras: Sequence[str] = (),
    choice: int = 0,
) -> tuple[dict[str, Any], list[str], bool]:
    """Return what init writes for these links and cameras, what it asked for, and whether it is complete."""
    found = [Autopilot(parse_link_url(url), (1, 1), PX4) for url in links]
    seen = [Camera(Candidate(uri, "cam"), CameraTrial(36, 1.2, 640, 480)) for uri in cameras]
    monkeypatch.setattr(setup, "find_autopilots", lambda *_, **__: found)
    monkeypatch.setattr(setup, "camera_candidates", lambda _: ([each.candidate for each in seen], []))
    monkeypatch.setattr(setup, "find_cameras", lambda *_: seen)
    monkeypatch.setattr(setup, "installed_runtimes", lambda: ["onnxruntime"])
    asked: list[str] = []

    def choose(what: str, choices: Sequence[str]) -> int:
        asked.append(what)
        return choice

    facts = Facts(target.settings, Machine())
    proposal = propose(target, facts, Asking(choose, lambda _: None, lambda _: None))
    text = merged(target.text, proposal.changes)
    return tomllib.loads(text), asked, proposal.has_autopilot


SERIAL, NETWORK = "serial:///dev/ttyAMA0:57600", "udpin://127.0.0.1:14540"


def test_defaults_that_fit_are_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = read_target(tmp_path / "companion.toml")
    assert proposed(monkeypatch, target, [NETWORK], ["/dev/video0"]) == ({}, [], True)


def test_choices_are_asked_for_and_the_chosen_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = read_target(tmp_path / "companion.toml")
    links, cameras = [NETWORK, SERIAL], ["/dev/video0", "csi://0"]
    written, asked, _ = proposed(monkeypatch, target, links, cameras, choice=1)
    assert asked == ["autopilot", "camera"]
    assert written == {"vehicle": {"url": SERIAL}, "source": {"uri": "csi://0"}}


def test_links_and_cameras_that_answer_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path := tmp_path / "companion.toml").write_text(
        f'[vehicle]\nurl = "{SERIAL}"\n[source]\nuri = "csi://1"\n'
    )
    target = read_target(path)
    written, asked, _ = proposed(monkeypatch, target, [SERIAL, NETWORK], ["csi://0", "csi://1"])
    assert asked == []
    assert written == target.tables


@pytest.mark.parametrize(
    "text",
    [
        '[vehicle]\nurl = "udpout://10.0.0.2:14540"\n[source]\nuri = "rtsp://10.0.0.3/main"\n',
        '[vehicle]\nurl = "udpout://10.0.0.2:14540"\n[source]\nuri = "flight.mp4"\n',
    ],
)
def test_what_cannot_be_tried_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    (path := tmp_path / "companion.toml").write_text(text)
    target = read_target(path)
    written, asked, has_autopilot = proposed(monkeypatch, target, [NETWORK], ["/dev/video0"])
    assert (written, asked, has_autopilot) == (target.tables, [], True)


def test_link_that_is_silent_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path := tmp_path / "companion.toml").write_text(
        f'[vehicle]\nurl = "{SERIAL}" # TELEM2\n[source]\nuri = "none"\n'
    )
    written, _, _ = proposed(monkeypatch, read_target(path), [NETWORK], ["/dev/video0"])
    assert written == {"vehicle": {"url": NETWORK}, "source": {"uri": "/dev/video0"}}


def test_camera_is_written_without_an_autopilot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = read_target(tmp_path / "companion.toml")
    assert proposed(monkeypatch, target, [], ["csi://0"]) == ({"source": {"uri": "csi://0"}}, [], False)
    assert proposed(monkeypatch, target, [], []) == ({}, [], False)


def test_faster_runtime_is_written_with_what_was_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = read_target(tmp_path / "companion.toml")
    said: list[Tried] = []
    asking = Asking(lambda *_: 0, lambda _: None, said.append)
    for fastest, expected in (("openvino", "openvino"), ("onnxruntime", None)):
        monkeypatch.setattr(setup, "installed_runtimes", lambda: ["onnxruntime", "openvino"])
        monkeypatch.setattr(setup, "fastest", lambda _, name=fastest: (name, "measured now: 9.1 ms"))
        changes = setup._runtime(target, asking)
        assert [each.value for each in changes] == ([expected] if expected else [])
        assert "9.1 ms" in said[-1].found
    (tmp_path / "companion.toml").write_text('[detector]\nmodel = "yolox_s"\n')
    assert setup._runtime(read_target(tmp_path / "companion.toml"), asking) == []


def test_written_file_says_where_each_value_is_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = read_target(tmp_path / "companion.toml")
    monkeypatch.setattr(
        setup, "find_autopilots", lambda *_, **__: [Autopilot(parse_link_url(SERIAL), (3, 1), PX4)]
    )
    asking = Asking(lambda *_: 0, lambda _: None, lambda _: None)
    changes, _ = setup._autopilot(target, Facts(Settings(), Machine()), asking, ())
    lines = merged("", changes).splitlines()
    for key in ("url", "system_id"):
        at = next(number for number, line in enumerate(lines) if line.startswith(key))
        assert lines[at - 1].startswith(f"{MARK}: ")
        assert "PX4" in lines[at - 1]
