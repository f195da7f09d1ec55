"""Checks of camera devices: there, permitted, and nobody else's; without a service also what they deliver."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from companion.doctor.check import Check, fault, ok, unknown, warning
from companion.doctor.facts import CheckKind, Facts
from companion.doctor.processes import holding_file
from companion.doctor.running import camera_label, slow_camera
from companion.doctor.serial_line import permission_problem
from companion.settings.perception import NO_SOURCE, SourceSection
from vision.redaction import redacted
from vision.sources.camera import camera_device
from vision.sources.v4l2 import PixelFormat, video_devices

NAME = "camera device"


def sources(facts: Facts) -> Iterator[tuple[str | None, SourceSection]]:
    """Yield the name and source of each camera that is used; the first has no name."""
    for name in (None, *facts.settings.cameras):
        source = facts.settings.of_camera(name).source
        if source.uri != NO_SOURCE:
            yield name, source


def device_of(source: SourceSection, facts: Facts) -> Path | None:
    """Return the path of a camera's device; None: the source is no camera of this computer."""
    device = camera_device(source.uri)
    return None if device is None else facts.machine.path(str(device))


def is_free(device: Path, facts: Facts) -> bool:
    """Whether a camera is there, may be opened, and is not seen to be open in another program."""
    return (
        device.exists()
        and permission_problem(device, facts.machine.user) is None
        and not holding_file(device, facts.machine.proc)
    )


def _devices(facts: Facts) -> Iterator[Check]:
    for name, source in sources(facts):
        device = device_of(source, facts)
        if device is not None:
            yield from _device(_label(name), device, source, facts)


def _label(name: str | None) -> str:
    return camera_label(name).replace("camera", NAME, 1)


def _device(label: str, device: Path, source: SourceSection, facts: Facts) -> Iterator[Check]:
    if not device.exists():
        nodes = sorted(str(path) for path in facts.machine.dev.glob("video*"))
        here = f"there are {', '.join(nodes[:6])}" if nodes else "there is no other"
        csi = "a CSI camera is csi://0" if not nodes else "companion describe cameras lists them"
        yield fault(label, f"{device} is not there; {here}", f"check cable and power; {csi}")
        return
    if (problem := permission_problem(device, facts.machine.user)) is not None:
        yield fault(label, *problem)
        return
    others = [
        each for each in holding_file(device, facts.machine.proc) if facts.service is None or not each.ours
    ]
    for each in others:
        yield fault(label, f"{device} is open in {each}: only one program gets images", each.freeing)
    if others:
        return
    if facts.service is None:
        yield from _format(label, device, source, facts)
    else:
        yield ok(label, f"{device} is there, and no other program is seen to have it open")


def _format(label: str, device: Path, source: SourceSection, facts: Facts) -> Iterator[Check]:
    """Compare what is asked for with what the driver offers."""
    found = next((each for each in video_devices(facts.machine.dev) if each.path == device.resolve()), None)
    if found is None or found.error:
        yield unknown(label, f"{device}: {'not a video device' if found is None else found.error}")
    elif found.kind != "camera":
        advice = "companion describe cameras lists the nodes with images"
        yield fault(label, f"{device} is a {found.kind} node and delivers no images", advice)
    elif not _offers(found.formats, source):
        asked = "x".join(str(each) for each in (source.width, source.height) if each)
        offered = ", ".join(each.fourcc for each in found.formats)
        wanted = " ".join(filter(None, (source.pixel_format, asked)))
        yield warning(label, f"{found.card} has no {wanted}; it has {offered}", "companion describe cameras")
    else:
        yield ok(label, f"{device}: {found.card}, {', '.join(each.fourcc for each in found.formats)}")


def _offers(formats: tuple[PixelFormat, ...], source: SourceSection) -> bool:
    for each in formats:
        if source.pixel_format is not None and each.fourcc != source.pixel_format:
            continue
        for size in each.sizes:
            if size.smallest is not None or (
                source.width in (None, size.width) and source.height in (None, size.height)
            ):
                return True
        if not each.sizes:
            return True
    return not formats


def _trials(facts: Facts) -> Iterator[Check]:
    for name, source in sources(facts):
        trial, label = facts.cameras.get(name), camera_label(name)
        if trial is None:
            continue
        if trial.problem:
            yield fault(label, redacted(trial.problem), "companion describe cameras; docs/how-to/cameras.md")
            continue
        rate_hz = trial.frames / trial.seconds if trial.seconds else 0.0
        text = f"{trial.width}x{trial.height}, {rate_hz:.1f} frames/s"
        yield slow_camera(label, text, rate_hz, source.rate_hz) or ok(label, text)


CHECKS = (
    CheckKind(
        NAME, "not there, not permitted, open in another program, a node or a format without images", _devices
    ),
    CheckKind("camera", "without a service: no frames, a low rate", _trials),
)
