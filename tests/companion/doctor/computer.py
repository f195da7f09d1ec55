"""A computer in a folder: /proc, /sys and /dev as the checks read them, and a service that publishes."""

from __future__ import annotations

import copy
import ipaddress
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from companion.bus.bodies.service import StatusBody
from companion.bus.bodies.vehicle import VehicleBody
from companion.doctor.check import Check, Verdict, worst_first
from companion.doctor.examine import KINDS
from companion.doctor.facts import Facts, Machine, Service, User, checks_of
from companion.settings import Settings

USER = User("pi", 12345, frozenset({os.getgid()}))
# Of a computer on which nothing is busy and everything free.
QUIET: dict[str, Any] = {
    "vehicle": {"url": "serial:///dev/ttyAMA0:921600"},
    "source": {"uri": "/dev/video0"},
    "detector": {"enabled": False},
}


@dataclass
class Computer:
    """Folders of a computer with a serial device and a camera; a test adds programs and files."""

    root: Path
    user: User = USER
    printed: dict[str, str] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)
    wall_s: float = field(default_factory=time.time)

    def __post_init__(self) -> None:
        for name in ("proc/net", "sys/class/thermal", "sys/class/hwmon", "dev", "etc"):
            (self.root / name).mkdir(parents=True)
        for name in ("ttyAMA0", "video0"):
            self.device(name)

    def device(self, name: str, mode: int = 0o660) -> Path:
        path = self.root / "dev" / name
        path.touch()
        path.chmod(mode)
        return path

    def program(
        self, pid: int, command: str, *, opened: Sequence[str | Path] = (), cgroup: str = "", parent: int = 1
    ) -> None:
        folder = self.root / "proc" / str(pid)
        (folder / "fd").mkdir(parents=True)
        words = command.split()
        (folder / "comm").write_text(f"{Path(words[0]).name[:15]}\n")
        (folder / "cmdline").write_bytes(b"\0".join(map(str.encode, words)) + b"\0")
        (folder / "stat").write_text(f"{pid} ({words[0]} :-)) S {parent} {pid}")
        (folder / "cgroup").write_text(f"0::{cgroup}\n")
        for number, target in enumerate(opened, 3):
            (folder / "fd" / str(number)).symlink_to(target)

    def socket(
        self, protocol: str, address: str, port: int, inode: int, *, user: int = 0, drops: int = 0
    ) -> None:
        file = self.root / "proc" / "net" / protocol
        if not file.exists():
            file.write_text("  sl  local_address rem_address   st ...\n")
        digits = ipaddress.ip_address(address).packed[::-1].hex().upper()
        state = "0A" if protocol == "tcp" else "07"
        line = f" 1: {digits}:{port:04X} 00000000:0000 {state} 0:0 00:0 0 {user} 0 {inode} 2 0 {drops}\n"
        with file.open("a") as opened:
            opened.write(line)

    def write(self, name: str, text: str) -> None:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")

    def machine(self) -> Machine:
        return Machine(
            proc=self.root / "proc",
            sys=self.root / "sys",
            dev=self.root / "dev",
            etc=self.root / "etc",
            log=self.root,
            environment=self.environment,
            user=self.user,
            output_of=lambda command: self.printed.get(command[0]),
            wall_s=self.wall_s,
        )

    def checks(self, settings: dict[str, Any] | None = None, **facts: Any) -> list[Check]:
        """Make all checks."""
        own = Facts(Settings.from_json(QUIET | (settings or {})), self.machine())
        return worst_first(checks_of(replace(own, **facts), KINDS))


def found(checks: Sequence[Check], name: str, verdict: Verdict) -> list[Check]:
    """The results of a name with a verdict."""
    return [check for check in checks if check.name == name and check.verdict is verdict]


CAMERA: dict[str, Any] = {
    "state": "running",
    "pid": 812,
    "restarts": 0,
    "frames": 300,
    "results": 300,
    "rate_hz": 30.0,
    "sequence": 300,
    "age_s": 0.05,
    "timing_ms": {"preprocess": 1.0, "inference": 20.0, "postprocess": 1.0},
    "timing_p50_ms": {"preprocess": 1.0, "inference": 20.0, "postprocess": 1.0},
    "timing_p99_ms": {"preprocess": 1.0, "inference": 20.0, "postprocess": 1.0},
    "dropped": 0,
    "frames_skipped": {},
    "frames_repeated": {"image": 0},
    "stuck_after_s": 10.0,
    "class_names": ["person"],
    "tracks": 1,
    "model": "yolox_s",
    "model_sha256": None,
    "runtime": "onnxruntime",
    "precision": "float32",
    "runtime_reason": "as requested",
    "problem": "",
}
STATUS: dict[str, Any] = {
    "stamp_ns": 10_000_000_000,
    "unix_offset_ns": 0,
    "service": "a1b2",
    "uptime_s": 60.0,
    "healthy": True,
    "unhealthy": [],
    "changed_settings": [],
    "parts": [
        {"name": name, "state": "ready", "reason": "", "since_ns": 0, "next_try_ns": None}
        for name in ("autopilot", "camera", "zenoh")
    ],
    "vehicle": {
        "name": "vehicle1",
        "connected": True,
        "autopilot": "PX4",
        "firmware": "1.16.2",
        "driver": "pymavlink",
        "mode": "hold",
        "armed": True,
        "failsafe": False,
        "not_flown": None,
        "sticks": None,
        "silence": {"effect": "hold", "mode": "hold", "after_s": 1.1, "warning": False, "text": "it holds"},
        "without_service": "it holds",
        "missing_streams": [],
        "reception": {"frames": 10_000, "split": 0, "lost": 0, "skipped_bytes": 0},
        "status_texts": ["Takeoff detected"],
        "other_commanders": [],
    },
    "pilot": {
        "in_command": False,
        "behaviour": "not in command",
        "stream": "idle",
        "setpoints_sent": 0,
        "mission": None,
        "command": None,
    },
    "limits": {
        "max_distance_m": 200.0,
        "max_altitude_m": 50.0,
        "max_horizontal_speed_mps": 5.0,
        "max_climb_mps": 2.0,
        "max_descend_mps": 1.0,
        "fence_include": [],
        "fence_exclude": [],
    },
    "perception": CAMERA,
    "cameras": {},
    "targets": {"camera": None, "count": 0, "localization_error": ""},
    "gimbal": None,
    "neighbours": {"ages_s": {}, "out_of_order": 0},
    "bus": {"connected": True, "published": {}, "publish_failed": 0, "refused_commands": 0, "ignored": {}},
    "log": {"dropped_lines": 0},
}


def changed_status(changes: dict[str, Any] | None = None) -> StatusBody:
    """The status of a sound service with changes: dotted path → value; a number selects in a list."""
    status = copy.deepcopy(STATUS)
    for path, value in (changes or {}).items():
        *folders, last = path.split(".")
        place: Any = status
        for folder in folders:
            place = place[int(folder) if isinstance(place, list) else folder]
        place[int(last) if isinstance(place, list) else last] = value
    return cast(StatusBody, status)


def service(
    changes: dict[str, Any] | None = None,
    *,
    before: dict[str, Any] | None = None,
    error_ns: int | None = 500_000,
) -> Service:
    """A service with two statuses, 30 frames and a second apart. `before`: changes of the first one."""
    first = {"stamp_ns": 9_000_000_000, "perception.frames": 270, **(before or {})}
    state = cast(VehicleBody, {"boot_error_ns": error_ns})
    return Service("vehicle1", True, (changed_status(first), changed_status(changes)), state)
