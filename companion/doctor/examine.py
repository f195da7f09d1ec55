"""Collects the facts, those that take time in parallel threads, and makes all checks of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from companion.doctor import (
    autopilot_ports,
    board,
    camera_device,
    heartbeats,
    installation,
    model,
    ports,
    running,
    serial_line,
)
from companion.doctor.check import Check, unknown, worst_first
from companion.doctor.facts import CameraTrial, CheckKind, Facts, Machine, checks_of
from companion.doctor.listening import Received, listen
from companion.doctor.processes import Program
from companion.doctor.service_query import find_service
from companion.settings import Settings, SourceSection
from companion.settings.layers import NO_FILES, SettingsFiles
from companion.settings.perception import NO_SOURCE
from companion.vehicle.link_url import LinkScheme, parse_link_url
from vision.sources.opening import open_source
from vision.sources.source import EndOfStream, Source, SourceError

LISTEN_S = 2.0
_CAMERA_S = 1.2
_CAMERA_OPEN_S = 3.0
# Of all that is tried at once: all together `doctor` takes at most 10 s.
_TRIALS_S = 5.0
# Sources that deliver by themselves, and are nobody's who writes to a pipe.
_LIVE = ("csi", "rtsp", "rtsps", "http", "https", "udp", "shm", "realsense", "oak")

KINDS: tuple[CheckKind, ...] = (
    *installation.CHECKS,
    *running.CHECKS,
    *serial_line.CHECKS,
    *ports.CHECKS,
    *heartbeats.CHECKS,
    *autopilot_ports.CHECKS,
    *camera_device.CHECKS,
    *model.CHECKS,
    *board.CHECKS,
)
"""All kinds of checks. Those of `running` and `autopilot_ports` need a service, `heartbeats` none."""
# What a service on another computer has is not looked for here.
_OF_ANOTHER = (*running.CHECKS, *autopilot_ports.CHECKS)
# With settings that cannot be read it is not known which devices are meant.
_WITHOUT_SETTINGS = (*installation.CHECKS, *running.CHECKS, *board.CHECKS)


def examine(
    settings: Settings | None,
    named: str | None,
    *,
    wrong: Sequence[str] = (),
    missing: Sequence[str] = (),
    files: SettingsFiles = NO_FILES,
    machine: Machine | None = None,
) -> list[Check]:
    """Look at this computer and at a running service, for at most 10 s.

    Args:
        settings: those that a service would start with; None: they cannot be read, and `wrong` says why.
        named: the vehicle's name; None: the only one alive.
        wrong, missing: what `check_settings` says of them. files: where they are from.

    Returns:
        All results, the worst first.
    """
    given = settings or Settings()
    found = find_service(given.zenoh, named)
    service = found.service
    if service is not None:
        settings, missing = found.settings, ()  # its parts say what it misses
    facts = Facts(
        settings or given,
        machine or Machine(),
        service,
        found.instead,
        tuple(wrong),
        tuple(missing),
        settings is not None,
        files,
    )
    if service is not None and not service.here:
        elsewhere = unknown(
            "this computer", "not looked at: the service runs on another one", "run companion doctor there"
        )
        return worst_first([*checks_of(facts, _OF_ANOTHER), elsewhere])
    if not facts.settings_known:
        return worst_first(checks_of(facts, _WITHOUT_SETTINGS))
    if service is None:
        facts = tried(facts)
    return worst_first(checks_of(facts, KINDS))


def tried(facts: Facts) -> Facts:
    """Return the facts with what the link and the cameras deliver, of those that nobody else has open."""
    why_not = why_not_received(facts)
    late = CameraTrial(problem=f"no answer within {_TRIALS_S:g} s")
    cameras: dict[str | None, CameraTrial] = {}
    received: list[Received] = []
    calls: list[Callable[[], None]] = []
    for name, source in camera_device.sources(facts):
        if may_open(source, facts):
            cameras[name] = late
            calls.append(partial(_keep_trial, source, partial(cameras.__setitem__, name)))
    if not why_not:
        url = parse_link_url(facts.settings.vehicle.url)
        calls.append(lambda: received.append(listen(url, LISTEN_S)))
    in_parallel(calls, _TRIALS_S)
    return replace(
        facts,
        received=received[0] if received else None,
        not_received=why_not or f"no end within {_TRIALS_S:g} s",
        cameras=dict(cameras),
    )


def why_not_received(facts: Facts) -> str:
    """Why the vehicle's link is not listened to; empty: it is."""
    if not facts.settings.vehicle.expected:
        return "vehicle.url is none"
    try:
        url = parse_link_url(facts.settings.vehicle.url)
    except ValueError:
        return "vehicle.url is not valid"
    if url.scheme is LinkScheme.UDP_OUT:
        return "at udpout:// the vehicle sends only after the service has"
    if url.scheme is LinkScheme.UDP_IN and not ports.is_free(facts, "vehicle port"):
        return f"UDP port {url.address[1]} is taken"
    path = serial_line.serial_device(facts)
    if path is None:
        return ""
    if not path.exists() or serial_line.permission_problem(path, facts.machine.user) is not None:
        return f"{path} cannot be opened"
    # A second reader would take bytes from the first.
    if held := [*serial_line.possible_holders(path, facts), *serial_line.silent_openers(path, facts)]:
        return f"{held[0]} may have {path} open"
    return ""


def link_holders(facts: Facts) -> list[Program]:
    """Return the programs that have the vehicle's link open: its UDP port or its serial device."""
    path = serial_line.serial_device(facts)
    return ports.held_by(facts, "vehicle port") if path is None else serial_line.possible_holders(path, facts)


def may_open(source: SourceSection, facts: Facts) -> bool:
    """Whether a camera can be opened for a moment: it is one, and nobody has it open."""
    if source.uri == NO_SOURCE:
        return False
    device = camera_device.device_of(source, facts)
    if device is None:
        return source.uri.partition("://")[0] in _LIVE and "://" in source.uri
    return camera_device.is_free(device, facts)


def _keep_trial(source: SourceSection, keep: Callable[[CameraTrial], None]) -> None:
    keep(camera_trial(source))


def camera_trial(source: SourceSection) -> CameraTrial:
    """Open a camera for a moment, at most some 7 s, and return what it delivers. Never raises for it."""
    opening = replace(source.opening(), depth=None, depth_scale=None, depth_calibration_file=None)
    opening = replace(opening, open_timeout_s=min(opening.open_timeout_s, _CAMERA_OPEN_S))
    try:
        with open_source(source.uri, opening) as opened:
            return _delivered(opened)
    except EndOfStream:
        return CameraTrial(problem=f"{source.uri}: has ended")
    except (SourceError, ValueError, ImportError) as error:
        return CameraTrial(problem=str(error))


def _delivered(source: Source) -> CameraTrial:
    frame = source.read(_CAMERA_OPEN_S)
    if frame is None:
        return CameraTrial(problem=f"no frame within {_CAMERA_OPEN_S:g} s")
    height, width = frame.image.shape[:2]
    began_s, count = time.monotonic(), 0
    while (seconds := time.monotonic() - began_s) < _CAMERA_S:
        count += source.read(_CAMERA_S - seconds) is not None
    return CameraTrial(count, seconds, width, height)


def in_parallel(calls: Sequence[Callable[[], None]], within_s: float) -> None:
    """Call functions in threads, and return when all have ended, or after a time.

    The threads do not hold up the end of the program.
    """
    threads = [threading.Thread(target=call, name="trial", daemon=True) for call in calls]
    for thread in threads:
        thread.start()
    deadline_s = time.monotonic() + within_s
    for thread in threads:
        thread.join(max(deadline_s - time.monotonic(), 0.0))
