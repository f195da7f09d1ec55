"""Each fault that a computer can have is made in a folder, and found with a line that mends it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from companion.doctor import board, camera_device, model
from companion.doctor.check import Verdict, exit_code
from companion.doctor.facts import CameraTrial, Facts, User, group_name
from companion.doctor.installation import check_packages
from companion.doctor.listening import Received, Sender
from companion.doctor.serial_line import possible_holders
from companion.settings import Settings
from tests.companion.doctor.computer import USER, Computer, found
from vision.sources.v4l2 import FrameSize, PixelFormat, VideoDevice

FAULT, WARNING, UNKNOWN = Verdict.FAULT, Verdict.WARNING, Verdict.UNKNOWN
USB = {"vehicle": {"url": "serial:///dev/ttyACM0:57600"}}
UDP = {"vehicle": {"url": "udpin://0.0.0.0:14540"}}
QUADROTOR, PX4 = 2, 12
SOUND = Received(2.0, {(1, 1): Sender(QUADROTOR, PX4, 2, False)}, 100)
WEBCAM = VideoDevice(
    Path("/dev/video0"),
    kind="camera",
    card="HD",
    formats=(PixelFormat("YUYV", "YUYV 4:2:2", (FrameSize(640, 480, (30.0,)),)),),
)


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Computer:
    """A sound one: nothing of the machine that runs the tests is left in it."""
    monkeypatch.setattr(board, "busy_text", lambda: "")
    monkeypatch.setattr(board, "_LEAST_FREE_MB", 1)
    monkeypatch.setattr(model, "torch_cuda", lambda: None)
    made = Computer(tmp_path)
    video = replace(WEBCAM, path=made.root / "dev" / "video0")
    monkeypatch.setattr(camera_device, "video_devices", lambda _dev: (video,))
    return made


def test_sound_computer_has_no_fault(computer: Computer) -> None:
    computer.write("sys/class/thermal/thermal_zone0/temp", "52000")
    computer.program(700, "/usr/bin/sshd -D")
    computer.printed["vcgencmd"] = "throttled=0x0\n"
    trial = {None: CameraTrial(36, 1.2, 640, 480)}
    checks = computer.checks(received=SOUND, cameras=trial)
    assert [check for check in checks if check.verdict is not Verdict.OK] == []
    assert exit_code(checks) == 0


Make = Callable[[Computer], Any]


def case(
    name: str, verdict: Verdict, advice: str, make: Make, settings: dict[str, Any] | None = None, **facts: Any
) -> Any:
    """A fault: the result's name and verdict, words of its advice or of what was found, how it is made."""
    return name, verdict, advice, make, settings, facts


def nothing(_computer: Computer) -> None:
    """The facts or settings are the fault."""


def getty(computer: Computer) -> None:
    unit = "/system.slice/system-serial\\x2dgetty.slice/serial-getty@ttyAMA0.service"
    computer.program(512, "/sbin/agetty -o -p 115200 ttyAMA0 vt220", cgroup=unit)


def reader(computer: Computer, cgroup: str = "") -> None:
    computer.program(900, "python3 read.py", opened=[computer.root / "dev" / "ttyAMA0"], cgroup=cgroup)


def modem_manager(computer: Computer) -> None:
    computer.device("ttyACM0")
    computer.program(300, "/usr/sbin/ModemManager")


def chip(computer: Computer, name: str, file: str, value: str) -> None:
    computer.write("sys/class/hwmon/hwmon1/name", name)
    computer.write(f"sys/class/hwmon/hwmon1/{file}", value)


def holder_of_port(computer: Computer, protocol: str, port: int, command: str = "mavlink-routerd") -> None:
    computer.socket(protocol, "0.0.0.0", port, 77)
    computer.program(910, command, opened=["socket:[77]"], cgroup="/system.slice/mavlink-router.service")


def supply(computer: Computer, text: str) -> None:
    computer.printed["vcgencmd"] = text


def zone(computer: Computer, milli_c: str) -> None:
    folder = "sys/class/thermal/thermal_zone0"
    computer.write(f"{folder}/temp", milli_c)
    computer.write(f"{folder}/trip_point_0_type", "critical")
    computer.write(f"{folder}/trip_point_0_temp", "105000")


def received(*senders: tuple[tuple[int, int], Sender], **more: Any) -> Received:
    return Received(2.0, dict(senders), len(senders), **more)


NEW_GROUP = User("pi", USER.uid, frozenset(), frozenset({os.getgid()}))
NO_GROUP = User("pi", USER.uid, frozenset())
OTHER = ((2, 1), Sender(QUADROTOR, PX4, 2, False))
AUTOPILOT = ((1, 1), Sender(QUADROTOR, PX4, 2, False))

FAULTS = {
    "serial device missing": case(
        "serial device", FAULT, "cable", lambda c: (c.root / "dev" / "ttyAMA0").unlink()
    ),
    "another serial device is there": case(
        "serial device", FAULT, "ttyACM1", lambda c: (c.root / "dev/ttyAMA0").rename(c.root / "dev/ttyACM1")
    ),
    "user not in the group": case(
        "serial permission",
        FAULT,
        f"sudo usermod -aG {group_name(os.getgid())} pi",
        lambda c: setattr(c, "user", NO_GROUP),
    ),
    "group since the last login": case(
        "serial permission", FAULT, "log out", lambda c: setattr(c, "user", NEW_GROUP)
    ),
    "device not for its group": case(
        "serial permission", FAULT, "sudo chmod g+rw", lambda c: c.device("ttyAMA0", 0o600)
    ),
    "getty": case("serial line", FAULT, "sudo systemctl disable --now serial-getty@ttyAMA0", getty),
    "nvgetty": case(
        "serial line",
        FAULT,
        "sudo systemctl disable --now nvgetty",
        lambda c: c.program(530, "/sbin/getty -L ttyAMA0 115200", cgroup="/system.slice/nvgetty.service"),
    ),
    "another reader": case("serial line", FAULT, "kill 900", reader),
    "reader of a user's manager": case(
        "serial line",
        FAULT,
        "systemctl --user disable --now ground",
        lambda c: reader(c, "/user.slice/user-1000.slice/user@1000.service/app.slice/ground.service"),
    ),
    "reader on a desktop": case(
        "serial line",
        FAULT,
        "kill 900",
        lambda c: reader(c, "/user.slice/user-1000.slice/user@1000.service/app.slice/terminal-1.scope"),
    ),
    "reader in a container": case(
        "serial line",
        FAULT,
        "docker stop 0123456789ab",
        lambda c: reader(c, cgroup=f"/system.slice/docker-0123456789ab{'c' * 52}.scope"),
    ),
    "router of another user": case(
        "serial line",
        FAULT,
        "sudo systemctl disable --now router",
        lambda c: c.program(
            40, "/usr/bin/mavlink-routerd /dev/ttyAMA0:921600", cgroup="/system.slice/router.service"
        ),
    ),
    "router that may have it": case(
        "serial line", UNKNOWN, "sudo companion doctor", lambda c: c.program(40, "/usr/bin/mavlink-routerd")
    ),
    "ModemManager": case(
        "ModemManager",
        WARNING,
        "sudo systemctl disable --now ModemManager",
        modem_manager,
        USB,
    ),
    "kernel console": case(
        "kernel console",
        FAULT,
        "console=ttyAMA0",
        lambda c: c.write("sys/class/tty/console/active", "tty0 ttyAMA0"),
    ),
    "UDP port taken": case(
        "vehicle port", FAULT, "vehicle.url", lambda c: holder_of_port(c, "udp", 14540), UDP
    ),
    "UDP port of another user": case(
        "vehicle port", FAULT, "sport = :14540", lambda c: c.socket("udp", "0.0.0.0", 14540, 5), UDP
    ),
    "a service that hangs": case(
        "vehicle port",
        FAULT,
        "on the ground",
        lambda c: holder_of_port(
            c, "udp", 14540, "/opt/companion/bin/python /opt/companion/bin/companion run"
        ),
        UDP,
    ),
    "zenoh port taken": case("zenoh port", FAULT, "zenoh.listen", lambda c: holder_of_port(c, "tcp", 7447)),
    "page port taken": case("page port", FAULT, "dashboard.listen", lambda c: holder_of_port(c, "tcp", 8088)),
    "UDP buffer too small": case(
        "UDP buffer", WARNING, "rmem_default", lambda c: c.socket("udp", "0.0.0.0", 14540, 5, drops=9), UDP
    ),
    "nothing received": case("heartbeats", FAULT, "MAV_1_CONFIG", nothing, received=received()),
    "wrong baud rate": case(
        "heartbeats", FAULT, "SER_TEL2_BAUD", nothing, received=received(skipped_bytes=4000)
    ),
    "another system id": case(
        "heartbeats", FAULT, "vehicle.system_id = 2", nothing, received=received(OTHER)
    ),
    "a signature without a key": case(
        "heartbeats",
        WARNING,
        "signing_key_file",
        nothing,
        received=received(((1, 1), Sender(QUADROTOR, PX4, 2, True))),
    ),
    "a key without a signature": case(
        "heartbeats",
        FAULT,
        "key",
        nothing,
        {"vehicle": {"url": "serial:///dev/ttyAMA0:921600", "signing_key_file": "***"}},
        received=received(AUTOPILOT),
    ),
    "two autopilots": case(
        "heartbeats",
        FAULT,
        "MAV_SYS_ID",
        nothing,
        received=received(
            ((1, 1), Sender(QUADROTOR, PX4, 4, False, frozenset({"10.0.0.1:1", "10.0.0.2:1"})))
        ),
    ),
    "a fixed wing": case(
        "heartbeats", FAULT, "safety", nothing, received=received(((1, 1), Sender(1, PX4, 2, False)))
    ),
    "a link that cannot be opened": case(
        "heartbeats", FAULT, "vehicle.url", nothing, received=Received(problem="no route")
    ),
    "bytes between frames": case(
        "heartbeats", WARNING, "baud rate", nothing, received=received(AUTOPILOT, skipped_bytes=90)
    ),
    "no camera": case("camera device", FAULT, "cable", lambda c: (c.root / "dev" / "video0").unlink()),
    "camera not permitted": case("camera device", FAULT, "chmod", lambda c: c.device("video0", 0o600)),
    "camera held": case(
        "camera device",
        FAULT,
        "kill 950",
        lambda c: c.program(950, "cheese", opened=[c.root / "dev" / "video0"]),
    ),
    "camera without the format": case(
        "camera device",
        WARNING,
        "YUYV",
        nothing,
        {"source": {"uri": "/dev/video0", "pixel_format": "MJPG", "width": 1280}},
    ),
    "camera without frames": case(
        "camera", FAULT, "cameras", nothing, cameras={None: CameraTrial(problem="no frame")}
    ),
    "slow camera": case(
        "camera",
        WARNING,
        "MJPG",
        nothing,
        {"source": {"uri": "/dev/video0", "rate_hz": 30.0}},
        cameras={None: CameraTrial(8, 1.0, 640, 480)},
    ),
    "no model file": case("model", FAULT, "models show", nothing, {"detector": {"model": "absent.onnx"}}),
    "bundled model on camera images": case("model", WARNING, "models pull", nothing, {"detector": {}}),
    "CUDA without a GPU": case(
        "torch", FAULT, 'device = "cpu"', nothing, {"detector": {"device": "cuda", "model": "absent.pt"}}
    ),
    "CUDA without torch of it": case(
        "torch",
        FAULT,
        "JetPack",
        lambda c: c.device("nvhost-gpu"),
        {"detector": {"device": "cuda", "model": "absent.pt"}},
    ),
    "undervoltage now": case("supply", FAULT, "5.1 V", lambda c: supply(c, "throttled=0x50005\n")),
    "undervoltage before": case("supply", WARNING, "cable", lambda c: supply(c, "throttled=0x50000\n")),
    "undervoltage of the kernel": case(
        "supply",
        FAULT,
        "cable",
        lambda c: chip(c, "rpi_volt", "in0_lcrit_alarm", "1"),
    ),
    "over-current of a Jetson": case(
        "supply",
        WARNING,
        "nvpmodel",
        lambda c: chip(c, "soctherm_oc", "oc1_event_cnt", "3"),
    ),
    "hot": case("temperature", WARNING, "cooling", lambda c: zone(c, "88000")),
    "too hot": case("temperature", FAULT, "cooling", lambda c: zone(c, "101000")),
    "clock of 1970": case("clock", WARNING, "timedatectl", lambda c: setattr(c, "wall_s", 3600.0)),
    "clock of 1970 on a signed link": case(
        "clock",
        WARNING,
        "signing",
        lambda c: setattr(c, "wall_s", 3600.0),
        {"vehicle": {"url": "none", "signing_key_file": "***"}},
    ),
    "recordings larger than the disk": case(
        "recordings",
        WARNING,
        "recording.max_total_mb =",
        nothing,
        {"recording": {"directory": ".", "max_total_mb": 100_000_000}},
    ),
    "misspelt variable": case(
        "environment",
        WARNING,
        "COMPANION_DETECTOR_CONFIDENCE",
        lambda c: c.environment.update(COMPANION_DETECTR__CONFIDENCE="0.5"),
    ),
    "wrong setting": case("settings", FAULT, "describe", nothing, wrong=("detector.model: absent",)),
    "missing folder": case("settings", WARNING, "later", nothing, missing=("recording.directory: x",)),
    "unit that fails": case(
        "service",
        FAULT,
        "journalctl -u companion",
        lambda c: c.printed.update(systemctl="ActiveState=failed\nExecMainStatus=2\n"),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_found(fault: str, computer: Computer) -> None:
    name, verdict, advice, make, settings, facts = FAULTS[fault]
    make(computer)
    checks = computer.checks(settings, **facts)
    results = found(checks, name, verdict)
    assert any(advice in f"{check.found} {check.advice}" for check in results), checks
    assert all(check.advice for check in results)
    assert not [check for check in checks if check.found.startswith("the check failed")]


def test_torch_with_cuda_and_no_gpu_is_a_warning(computer: Computer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model, "torch_cuda", lambda: "12.8")
    assert found(computer.checks(), "torch", WARNING)
    computer.device("nvidiactl")
    assert found(computer.checks(), "torch", Verdict.OK)


def test_full_disk_is_a_fault(computer: Computer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board, "_LEAST_FREE_MB", 10**12)
    assert found(computer.checks(), "disk", FAULT)


@pytest.mark.parametrize(
    ("kind", "life", "reserve", "verdict"),
    [
        ("MMC", "0x01 0x02", "0x01", Verdict.OK),
        ("MMC", "0x01 0x09", "0x01", WARNING),
        ("MMC", "0x01 0x01", "0x02", WARNING),
        ("MMC", "0x0b 0x01", "0x01", FAULT),
        ("MMC", "0x01 0x01", "0x03", FAULT),
        ("MMC", "", "", UNKNOWN),
        ("SD", "", "", Verdict.OK),
    ],
)
def test_worn_disk_of_journal_and_recordings_is_found(
    kind: str, life: str, reserve: str, verdict: Verdict, computer: Computer
) -> None:
    number = computer.root.stat().st_dev
    disk = "sys/devices/mmc_host/mmc0/block/mmcblk0"
    for name, text in {"type": kind, "life_time": life, "pre_eol_info": reserve}.items():
        computer.write(f"{disk}/device/{name}", text)
    computer.write(f"{disk}/mmcblk0p2/partition", "2")
    link = computer.root / "sys/dev/block" / f"{os.major(number)}:{os.minor(number)}"
    link.parent.mkdir(parents=True)
    link.symlink_to(computer.root / disk / "mmcblk0p2")
    (check,) = found(computer.checks({"recording": {"directory": str(computer.root)}}), "disk wear", verdict)
    assert "mmcblk0" in check.found


def test_busy_computer_is_a_warning(computer: Computer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(board, "busy_text", lambda: "; the computer is busy")
    assert found(computer.checks(), "scheduling", WARNING)


def test_node_without_images_is_a_fault(computer: Computer, monkeypatch: pytest.MonkeyPatch) -> None:
    node = VideoDevice(computer.root / "dev" / "video0", kind="metadata")
    monkeypatch.setattr(camera_device, "video_devices", lambda _dev: (node,))
    assert found(computer.checks(), "camera device", FAULT)


@pytest.mark.parametrize(
    ("line", "there", "verdict"),
    [
        ("numpy>=2.0", "1.26.4", FAULT),
        ("numpy>=2.0", "2.0.0", Verdict.OK),
        ("numpy>=2.0", None, FAULT),
        ("torch>=2.10; extra == 'models'", "2.9.1+cpu", WARNING),
        ("torch>=2.10; extra == 'models'", "2.10.0+cpu", Verdict.OK),
        ("torch>=2.10; extra == 'models'", None, Verdict.OK),
        ("mavlink-companion[models]; extra == 'all'", None, Verdict.OK),
        ('setuptools>=77; extra == "dev"', "66.1.1", Verdict.OK),
    ],
)
def test_package_below_its_lower_bound_is_found(line: str, there: str | None, verdict: Verdict) -> None:
    (check,) = check_packages([line], lambda _name: there)
    assert check.verdict is verdict


def test_port_of_another_address_is_free(computer: Computer) -> None:
    computer.socket("udp", "192.168.1.5", 14540, 5)
    settings = {"vehicle": {"url": "udpin://127.0.0.1:14540"}}
    assert found(computer.checks(settings), "vehicle port", Verdict.OK)


def test_failing_check_is_a_result(computer: Computer, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_dev: Path) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(camera_device, "video_devices", broken)
    assert found(computer.checks(), "camera device", UNKNOWN)


def test_shell_that_started_doctor_is_no_reader(computer: Computer) -> None:
    line = "bash -c companion doctor --vehicle-url serial:///dev/ttyAMA0:921600"
    computer.program(4_000_001, line)
    computer.program(os.getpid(), "companion doctor", parent=4_000_001)
    assert found(computer.checks(), "serial line", Verdict.OK)


@pytest.mark.parametrize(
    ("device", "command", "holds"),
    [
        ("ttyAMA0", "/usr/bin/mavlink-routerd /dev/ttyAMA0:921600", True),
        ("ttyAMA0", "/sbin/getty -L ttyAMA0 115200", True),
        ("ttyAMA0", "/usr/bin/tail /var/log/ttyAMA0.log", False),
        ("pts/1", "/usr/bin/sleep 1", False),  # a number is no device
        ("pts/1", "/usr/bin/mavlink-routerd 1:921600", False),
    ],
)
def test_only_a_word_that_names_the_device_makes_a_holder(
    computer: Computer, device: str, command: str, holds: bool
) -> None:
    computer.program(900, command)
    facts = Facts(Settings(), computer.machine())
    found_pids = [each.pid for each in possible_holders(computer.root / "dev" / device, facts)]
    assert found_pids == ([900] if holds else [])
