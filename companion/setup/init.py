"""What `companion init` finds out, and the changes of the settings that follow from it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.doctor.camera_device import device_of
from companion.doctor.facts import Facts, Service
from companion.settings import Settings
from companion.settings.perception import NO_SOURCE, SourceSection
from companion.setup.autopilots import MOST_S, Autopilot, find_autopilots, url_of
from companion.setup.cameras import Camera, camera_candidates, find_cameras
from companion.setup.runtimes import DEFAULT_RUNTIME, fastest, installed_runtimes
from companion.setup.settings_file import Change
from companion.setup.target import Target
from companion.setup.tried import Report, Tried
from companion.vehicle.link_url import LinkScheme

# Cameras of this computer: what is no longer there may be replaced by what is. Others are left as they are.
_OWN = ("csi://", "realsense://", "oak://")


@dataclass(frozen=True, slots=True)
class Asking:
    """How people are asked and informed.

    Attributes:
        choose: returns the index of one of several choices, the surest of which is the first.
        say: prints a line. report: prints what was tried.
    """

    choose: Callable[[str, Sequence[str]], int]
    say: Callable[[str], None]
    report: Report


@dataclass(frozen=True, slots=True)
class Proposal:
    """What is to be changed.

    Attributes:
        has_autopilot: one answers, or there is to be none.
    """

    changes: tuple[Change, ...]
    has_autopilot: bool


def propose(
    target: Target,
    facts: Facts,
    asking: Asking,
    *,
    service: Service | None = None,
    service_settings: Settings | None = None,
    devices: Iterable[Path] = (),
) -> Proposal:
    """Look at this computer, and return what differs from the defaults.

    A value of the file stays while what it names answers.

    Args:
        service: a service that runs on this computer: it has link and cameras open. service_settings: its.
        devices: serial devices that are looked at too.
    """
    changes: list[Change] = []
    own = service_settings if service is not None else None
    status = service.status if service is not None else None
    if own is not None and status is not None and status["vehicle"]["connected"]:
        asking.say(f"autopilot: the running service has it at {own.vehicle.url}")
        reason = "that of the running service"
        changes += target.changes("vehicle.url", own.vehicle.url, reason)
        changes += target.changes("vehicle.system_id", own.vehicle.system_id, reason)
        has_autopilot = True
    else:
        found, has_autopilot = _autopilot(target, facts, asking, devices)
        changes += found
    if own is not None and status is not None and (status["perception"] or {}).get("state") == "running":
        asking.say(f"camera: the running service has {own.source.uri} open")
        changes += target.changes("source.uri", own.source.uri, "that of the running service")
    else:
        changes += _camera(target, facts, asking, worth_none=has_autopilot)
    return Proposal(tuple(changes), has_autopilot)


def _autopilot(
    target: Target, facts: Facts, asking: Asking, devices: Iterable[Path]
) -> tuple[list[Change], bool]:
    in_file = target.settings.vehicle.url if target.has("vehicle.url") else None
    present = None if in_file is None else url_of(in_file)
    if present is not None and present.scheme is LinkScheme.UDP_OUT:
        asking.say(f"autopilot: vehicle.url = {present} stays: it can only be tried by sending")
        return [], True
    asking.say(f"autopilot: listening on serial lines and network ports, at most {MOST_S:g} s")
    autopilots = find_autopilots(facts, asking.report, present=present, devices=devices)
    if not autopilots:
        if in_file is not None:
            asking.say(f"autopilot: vehicle.url = {in_file} stays")
        return [], in_file is not None and present is None
    chosen = autopilots[0]
    if len(autopilots) > 1 and chosen.url != present:
        chosen = autopilots[asking.choose("autopilot", [f"{each.url}: {each}" for each in autopilots])]
    return _of_autopilot(target, chosen), True


def _of_autopilot(target: Target, autopilot: Autopilot) -> list[Change]:
    reason = f"received: {autopilot}"
    return [
        *target.changes("vehicle.url", str(autopilot.url), reason),
        *target.changes("vehicle.system_id", autopilot.address[0], reason),
    ]


def _camera(target: Target, facts: Facts, asking: Asking, *, worth_none: bool) -> list[Change]:
    """Return the changes for the first camera. `worth_none`: without one the service is to run without."""
    present = target.settings.source if target.has("source.uri") else None
    if present is not None and not _may_be_replaced(present, facts):
        asking.say(f"camera: source.uri = {present.uri} stays")
        return []
    asking.say("camera: each is opened for a moment")
    candidates, others = camera_candidates(facts)
    for each in others:
        asking.report(each)
    cameras = find_cameras(candidates, facts, asking.report)
    if not cameras:
        if not candidates and not others:
            asking.report(
                Tried("/dev/video*, csi://", "no camera", "connect one, and run companion init again")
            )
        without = worth_none and present is None
        return target.changes("source.uri", NO_SOURCE, "no camera was found") if without else []
    chosen = next((each for each in cameras if present is not None and _is(each, present, facts)), None)
    if chosen is not None:
        return _runtime(target, asking)
    chosen = cameras[0]
    if len(cameras) > 1:
        chosen = cameras[asking.choose("camera", [f"{each.uri}: {each}" for each in cameras])]
    return [*target.changes("source.uri", chosen.uri, str(chosen)), *_runtime(target, asking)]


def _may_be_replaced(source: SourceSection, facts: Facts) -> bool:
    """Whether it is a camera of this computer, or none."""
    return source.uri == NO_SOURCE or source.uri.startswith(_OWN) or device_of(source, facts) is not None


def _is(camera: Camera, source: SourceSection, facts: Facts) -> bool:
    device = device_of(source, facts)
    if device is None or camera.candidate.device is None:
        return camera.uri == source.uri
    return device.resolve() == camera.candidate.device.resolve()


def _runtime(target: Target, asking: Asking) -> list[Change]:
    """Return the change to the fastest runtime: of the bundled model, where no other is chosen."""
    if target.has("detector.runtime") or target.has("detector.model") or target.has("detector.enabled"):
        return []
    try:
        names = installed_runtimes()
        if len(names) < 2:
            return []
        asking.say(f"detector: measuring {', '.join(names)}" + _minutes(names))
        name, measured = fastest(target.settings.detector)
    except (ValueError, RuntimeError) as error:
        asking.report(Tried("detector", str(error), "companion models show"))
        return []
    asking.report(Tried("detector", f"{name} is the fastest: {measured}"))
    # Where it is not set, an installation with another runtime starts with that one's default.
    if name == DEFAULT_RUNTIME:
        return []
    return target.changes("detector.runtime", name, measured)


def _minutes(names: Sequence[str]) -> str:
    return " (tensorrt takes minutes)" if "tensorrt" in names else ""
