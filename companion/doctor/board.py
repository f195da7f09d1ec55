"""Checks of the board: supply, temperature, clock, scheduler, disk."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import resource
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from companion.doctor.check import Check, fault, ok, unknown, warning
from companion.doctor.facts import CheckKind, Facts
from companion.host.load import busy_text
from vision.home import expanded

# `vcgencmd get_throttled`: now, and since the start.
_PI_BITS = (
    (0, "undervoltage"),
    (1, "processor frequency capped"),
    (2, "throttled"),
    (3, "temperature limit"),
)
_SINCE_START = 16
# Boards throttle from here on, a Raspberry Pi without a trip point for it.
_HOT_C = 80.0
# Where a driver has no limits. `passive` is none: it throttles on purpose, often far below.
_LIMITS, _USUAL_LIMIT_C = ("hot", "critical"), 95.0
_NEAR_C = 5.0
_MB = 1_000_000
_LEAST_FREE_MB = 500
# eMMC, JEDEC JESD84-B51: life in tenths, one more is beyond; of its reserved blocks 80 %, then 90 % are used.
_LIFE_TENTHS, _WORN_TENTHS, _RESERVE_LOW, _URGENT = 10, 9, 2, 3
_TIME_ERROR = 5  # of adjtimex(2): the clock is not synchronised
_TIMEX_BYTES = 512  # more than struct timex has


def _supply(facts: Facts) -> Iterator[Check]:
    machine, name = facts.machine, "supply"
    advice = "a supply of 5.1 V and 5 A (Pi 5) or a shorter, thicker cable"
    for folder in sorted((machine.sys / "class" / "hwmon").glob("hwmon*")):
        chip = machine.text("class", "hwmon", folder.name, "name")
        if chip == "rpi_volt" and machine.text("class", "hwmon", folder.name, "in0_lcrit_alarm") == "1":
            yield fault(name, "undervoltage: the supply falls below 4.63 V", advice)
            return
        if chip == "soctherm_oc":
            counts = {each.name: _number(each) for each in sorted(folder.glob("oc*_event_cnt"))}
            if any(counts.values()):
                events = ", ".join(f"{key}: {count:.0f}" for key, count in counts.items() if count)
                found = f"over-current throttling since the start ({events})"
                yield warning(name, found, "a stronger supply, or a lower mode: sudo nvpmodel -q")
                return
    text = machine.output_of(("vcgencmd", "get_throttled"))
    match = None if text is None else re.search(r"throttled=0x([0-9a-fA-F]+)", text)
    if match is None:
        return
    bits = int(match[1], 16)
    now = [words for bit, words in _PI_BITS if bits >> bit & 1]
    before = [words for bit, words in _PI_BITS if bits >> (bit + _SINCE_START) & 1]
    if now:
        yield fault(name, f"now: {', '.join(now)}", advice)
    elif before:
        yield warning(name, f"since the start: {', '.join(before)}", advice)
    else:
        yield ok(name, "no undervoltage and no throttling since the start")


def _temperature(facts: Facts) -> Iterator[Check]:
    hottest: tuple[float, str, float] | None = None
    for zone in sorted((facts.machine.sys / "class" / "thermal").glob("thermal_zone*")):
        value = _number(zone / "temp")
        if value is None or not -40_000 < value < 200_000:  # a sensor that is off
            continue
        limits = [
            limit / 1000
            for kind in zone.glob("trip_point_*_type")
            if _text(kind) in _LIMITS
            and (limit := _number(kind.with_name(kind.name.replace("_type", "_temp")))) is not None
            and limit > 0
        ]
        limit_c = min(limits, default=_USUAL_LIMIT_C)
        found = value / 1000, _text(zone / "type") or zone.name, limit_c
        if hottest is None or found[0] - found[2] > hottest[0] - hottest[2]:
            hottest = found
    if hottest is None:
        return
    value_c, where, limit_c = hottest
    text = f"{where}: {value_c:.0f} °C, its limit is {limit_c:.0f} °C"
    if value_c >= min(_HOT_C, limit_c - _NEAR_C):
        kind = fault if value_c >= limit_c - _NEAR_C else warning
        yield kind("temperature", text, "cooling, or a smaller detector.image_size")
    else:
        yield ok("temperature", text)


def synchronised() -> bool | None:
    """Whether the kernel's clock is kept by NTP, PTP or GPS (adjtimex(2)); None: not known."""
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (OSError, AttributeError):
        return None
    return None if state < 0 else state != _TIME_ERROR


def _clock(facts: Facts) -> Iterator[Check]:
    machine = facts.machine
    now = time.strftime("%Y-%m-%d %H:%M", time.gmtime(machine.wall_s))
    if machine.wall_s < machine.built_s - 86400:
        signs = facts.settings.vehicle.signing_key_file is not None
        yield warning(
            "clock",
            f"it is {now} UTC here, before this program was installed: names of recordings and TLS are wrong"
            f"{'; MAVLink signing goes on from its kept timestamp' if signs else ''}",
            "sudo timedatectl set-ntp true with a network, a clock with a battery, or fake-hwclock",
        )
        return
    kept = synchronised()
    state = (
        "not known whether it is synchronised"
        if kept is None
        else "synchronised"
        if kept
        else "not synchronised"
    )
    yield ok("clock", f"{now} UTC, {state}")


def _scheduling(facts: Facts) -> Iterator[Check]:
    release = platform.release()
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0] if hasattr(resource, "RLIMIT_RTPRIO") else 0
    real_time = os.geteuid() == 0 or limit != 0
    text = f"kernel {release}, real-time policy {'permitted' if real_time else 'not permitted'} here"
    if busy := busy_text():
        yield warning(
            "scheduling",
            f"{text}{busy}",
            "CPUSchedulingPolicy=rr, docs/safety.md, Real-time policy; or fewer programs",
        )
    else:
        yield ok("scheduling", text)


def _disk(facts: Facts) -> Iterator[Check]:
    directory = facts.settings.recording.directory
    if directory:
        folder = expanded(directory).absolute()
        yield _space("recordings", folder, facts.settings.recording.max_total_mb)
    yield _space("disk", facts.machine.log if facts.machine.log.exists() else Path("/"), None)


def _space(name: str, folder: Path, planned_mb: int | None) -> Check:
    there = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        free_mb = shutil.disk_usage(there).free / _MB
        used_mb = 0.0
        if planned_mb is not None and folder.is_dir():
            used_mb = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / _MB
    except OSError as error:
        return unknown(name, f"{there}: {error.strerror}")
    text = f"{free_mb / 1000:.1f} GB are free at {there}"
    if free_mb < _LEAST_FREE_MB:
        return fault(name, text, "sudo journalctl --vacuum-size=200M, and remove what is not needed")
    if planned_mb is not None and used_mb + free_mb < planned_mb + _LEAST_FREE_MB:
        most = max(int(used_mb + free_mb) - 2 * _LEAST_FREE_MB, 1)
        found = f"{text}; recording.max_total_mb is {planned_mb}, of which {used_mb:.0f} are used"
        return warning(name, found, f"recording.max_total_mb = {most}")
    return ok(name, text)


def _wear(facts: Facts) -> Iterator[Check]:
    """Of the disks with the journal and the recordings, what eMMC reports: the kernel's mmc-dev-attrs."""
    directory = facts.settings.recording.directory
    folders = [facts.machine.log, *([expanded(directory).absolute()] if directory else [])]
    devices: dict[Path, None] = {}
    for folder in folders:
        there = next(path for path in (folder, *folder.parents) if path.exists())
        number = there.stat().st_dev
        node = (facts.machine.sys / "dev/block" / f"{os.major(number)}:{os.minor(number)}").resolve()
        devices |= dict.fromkeys(disk for disk in (node, node.parent) if (disk / "device" / "type").exists())
    for disk in devices:
        kind = _text(disk / "device" / "type")
        if kind == "SD":
            yield ok("disk wear", f"{disk.name} is an SD card, which reports none: recordings wear it")
        elif kind == "MMC":
            yield _worn(disk)


def _worn(disk: Path) -> Check:
    words = [*_text(disk / "device" / "life_time").split(), _text(disk / "device" / "pre_eol_info")]
    try:
        *lives, reserve = (int(word, 16) for word in words)
    except ValueError:
        return unknown("disk wear", f"{disk.name} does not report it")
    tenths = max(lives, default=0)
    text = f"{disk.name} has used {(tenths - 1) * 10} to {tenths * 10} % of its life" if tenths else disk.name
    advice = "replace it; until then recording.directory on another disk, and a smaller journal"
    if tenths > _LIFE_TENTHS or reserve >= _URGENT:
        return fault("disk wear", f"{disk.name} is at the end of its life", advice)
    if tenths >= _WORN_TENTHS or reserve == _RESERVE_LOW:
        return warning("disk wear", text, advice)
    return ok("disk wear", text)


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip("\0 \n")
    except OSError:
        return ""


def _number(path: Path) -> float | None:
    try:
        return float(_text(path))
    except ValueError:
        return None


CHECKS = (
    CheckKind("supply", "undervoltage and throttling of a Raspberry Pi, over-current of a Jetson", _supply),
    CheckKind("temperature", "a board near its limit", _temperature),
    CheckKind("clock", "a clock before the installation", _clock),
    CheckKind(
        "scheduling", "a busy computer; the kernel, and whether a real-time policy is permitted", _scheduling
    ),
    CheckKind("disk", "little space for the journal, or less than `recording.max_total_mb`", _disk),
    CheckKind("disk wear", "eMMC near the end of its life", _wear),
)
