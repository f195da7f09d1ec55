"""The screens of `companion doctor` and `companion status`, as lines without colour of a given width."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

from companion.bus.bodies.service import StatusBody, StatusCameraBody
from companion.doctor.check import Check, Verdict
from companion.doctor.facts import Facts
from companion.doctor.running import cameras_of, duration_text

_INDENT = 9  # of the longest verdict, and a space
_EVENTS, _TEXTS = 4, 3
_SPAN = 8  # of a key of `status`


def doctor_lines(checks: Sequence[Check], width: int) -> Iterator[str]:
    """Yield the results, those that need an action whole, the others as one line each."""
    names = max((len(check.name) for check in checks if check.verdict is Verdict.OK), default=0)
    for check in checks:
        if check.verdict is Verdict.OK:
            yield shortened(f"{'ok':<{_INDENT}}{check.name:<{names}}  {check.found}", width)
        else:
            yield from check_lines(check, width)
    counts = [
        f"{count} {_plural(verdict, count)}"
        for verdict in Verdict
        if (count := sum(check.verdict is verdict for check in checks))
    ]
    yield ", ".join(counts)


def check_lines(check: Check, width: int) -> Iterator[str]:
    """Yield one result: what was found, and what mends it."""
    yield from _wrapped(f"{check.verdict.value:<{_INDENT}}", f"{check.name}: {check.found}", width)
    if check.advice:
        yield from _wrapped(f"{'':<{_INDENT}}→ ", check.advice, width)


def _plural(verdict: Verdict, count: int) -> str:
    words = {Verdict.UNKNOWN: "not checked", Verdict.OK: "ok"}
    return words.get(verdict) or f"{verdict.value}{'' if count == 1 else 's'}"


def status_lines(facts: Facts, checks: Sequence[Check], width: int) -> Iterator[str]:
    """Yield one screen of a running service.

    Args:
        checks: of the service; those that are not ok are the reasons.
    """
    service = facts.service
    assert service is not None
    if (status := service.status) is None:
        yield from _reasons(checks, width)
        return
    now_ns = status["stamp_ns"]
    state = "healthy" if status["healthy"] else f"not healthy: {'; '.join(status['unhealthy'])}"
    yield from _row(
        "vehicle", f"{service.vehicle}, up for {duration_text(status['uptime_s'])}, {state}", width
    )
    for key, text in (
        ("link", _link(status)),
        ("mode", _mode(status)),
        ("command", _command(status)),
        ("silence", status["vehicle"]["silence"]["text"] if status["vehicle"]["connected"] else ""),
        ("limits", _limits(status)),
    ):
        if text:
            yield from _row(key, text, width)
    for name, camera in cameras_of(status).items():
        if camera["state"] != "stopped":
            yield from _row("camera" if name is None else name, _camera(camera), width)
    yield from _row("parts", ", ".join(f"{part['name']} {part['state']}" for part in status["parts"]), width)
    yield from _reasons(checks, width)
    for text in status["vehicle"]["status_texts"][-_TEXTS:]:
        yield shortened(f"{'texts':<{_SPAN}} {text}", width)
    for event in [each for each in service.events if each["level"] != "info"][-_EVENTS:]:
        age = duration_text(max(now_ns - event["stamp_ns"], 0) / 1e9)
        yield shortened(f"{event['level']:<{_SPAN}} {age} ago: {event['text']}", width)


def _reasons(checks: Sequence[Check], width: int) -> Iterator[str]:
    for check in checks:
        if check.verdict is not Verdict.OK:
            yield from check_lines(check, width)


def _link(status: StatusBody) -> str:
    vehicle, received = status["vehicle"], status["vehicle"]["reception"]
    if not any(part["name"] == "autopilot" for part in status["parts"]):
        return "no vehicle: vehicle.url is none"
    if not vehicle["connected"]:
        return "no heartbeat"
    total = max(received["frames"] + received["lost"], 1)
    name = f"{vehicle['autopilot'] or 'autopilot'} {vehicle['firmware'] or '(version unknown)'}"
    lost = received["lost"]
    return f"{name} by {vehicle['driver']}, {lost} of {total} frames lost ({lost / total:.1%})"


def _mode(status: StatusBody) -> str:
    vehicle = status["vehicle"]
    if not vehicle["connected"]:
        return ""
    words = [vehicle["mode"], "armed" if vehicle["armed"] else "disarmed"]
    words += ["FAILSAFE"] if vehicle["failsafe"] else []
    return ", ".join([*words, "we are in command" if status["pilot"]["in_command"] else "not in command"])


def _command(status: StatusBody) -> str:
    pilot = status["pilot"]
    command = pilot["command"]
    if command is None:
        return "none"
    text, doing = command["command"].splitlines()[0], pilot["behaviour"]
    if (mission := pilot["mission"]) is not None:
        step = mission["steps"][mission["current"]] if mission["current"] < len(mission["steps"]) else "end"
        doing = f"step {mission['current'] + 1} of {len(mission['steps'])}, {step}"
    return text if not doing or doing == text else f"{text} ({doing})"


def _limits(status: StatusBody) -> str:
    limits = status["limits"]
    fence = ", fence" if limits["fence_include"] or limits["fence_exclude"] else ""
    return (
        f"{limits['max_distance_m']:g} m from home, {limits['max_altitude_m']:g} m high, "
        f"{limits['max_horizontal_speed_mps']:g} m/s{fence}"
    )


def _camera(camera: StatusCameraBody) -> str:
    words = [camera["state"], f"{camera['rate_hz']:.1f} results/s"]
    if camera["age_s"] is not None:
        words.append(f"newest {camera['age_s']:.2f} s old")
    if camera["model"] is not None:
        words.append(f"{camera['model']} on {camera['runtime']}")
    return ", ".join([*words, f"{camera['tracks']} tracks", f"{camera['restarts']} restarts"])


def shortened(text: str, width: int) -> str:
    """Return a text in one line of a width."""
    text = " ".join(text.splitlines())
    return text if len(text) <= width else f"{text[: width - 1]}…"


def _row(key: str, text: str, width: int) -> Iterator[str]:
    yield from _wrapped(f"{key:<{_SPAN}} ", text, width)


def _wrapped(begin: str, text: str, width: int) -> Iterator[str]:
    """Break at spaces alone: a command must not be cut at its hyphens."""
    yield from textwrap.wrap(
        " ".join(text.split()),
        width,
        initial_indent=begin,
        subsequent_indent=" " * len(begin),
        break_long_words=False,
        break_on_hyphens=False,
    )
