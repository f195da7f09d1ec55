"""Checks of a running service, from what it publishes: the reasons of `companion status` too."""

from __future__ import annotations

from collections.abc import Iterator

from companion.bus.bodies.service import StatusBody, StatusCameraBody
from companion.doctor.check import Check, fault, ok, unknown, warning
from companion.doctor.facts import CheckKind, Facts, Service
from companion.vehicle.vehicle_type import NOT_KNOWN_YET

UNIT = "companion"
LOG = "journalctl -u companion -p warning"
_UP = ("ready", "finished")
# A camera's part, whose own check says more.
_CAMERA = "camera"
# A share of frames that a sound serial line or network does not lose.
_LOST = 0.01
# The offset of the clocks is used for the stamps of attitudes: at 100 degrees/s 20 ms are 2 degrees.
_SYNC_ERROR_MS = 20.0
# A camera that delivers fewer frames than this share of what was asked for does not deliver that rate.
_RATE_SHARE = 0.7
_REPEATED = 0.2
_STAGES = ("preprocess", "inference", "postprocess")
_WAITING = {
    "autopilot": "check its power, the cable, and vehicle.url: companion describe settings",
    "zenoh": "start the router, or correct zenoh.connect",
}


def cameras_of(status: StatusBody) -> dict[str | None, StatusCameraBody]:
    """Return the cameras by name; the first has none."""
    cameras: dict[str | None, StatusCameraBody] = {None: status["perception"]}
    cameras.update(status["cameras"].items())
    return cameras


def camera_label(name: str | None) -> str:
    """Return the name of a camera's part and checks."""
    return _CAMERA if name is None else f"{_CAMERA} {name}"


def _status(facts: Facts) -> StatusBody | None:
    return None if facts.service is None else facts.service.status


def _service(facts: Facts) -> Iterator[Check]:
    if facts.reached is not None:
        yield facts.reached
    if (service := facts.service) is None:
        yield from _unit(facts)
        return
    if (status := service.status) is None:
        found = f"the service of vehicle {service.vehicle!r} is there and publishes no status"
        yield fault("service", found, "sudo systemctl restart companion, only on the ground")
        return
    yield ok("service", f"vehicle {service.vehicle}, up for {duration_text(status['uptime_s'])}")


def _unit(facts: Facts) -> Iterator[Check]:
    """Systemd's unit, where it is to run and does not."""
    shown = facts.machine.output_of(("systemctl", "show", UNIT, "--property=ActiveState,ExecMainStatus"))
    state = dict(line.split("=", 1) for line in (shown or "").splitlines() if "=" in line)
    if state.get("ActiveState") in ("failed", "activating"):
        found = (
            f"{UNIT}.service is {state['ActiveState']}; its last exit code is {state.get('ExecMainStatus')}"
        )
        yield fault("service", found, f"journalctl -u {UNIT} -n 20")


def _parts(facts: Facts) -> Iterator[Check]:
    if (status := _status(facts)) is None:
        return
    for part in status["parts"]:
        name, state, reason = part["name"], part["state"], part["reason"]
        if name == _CAMERA or name.startswith(f"{_CAMERA} "):
            continue
        if state in _UP:
            yield ok(name, state if name != "autopilot" else _autopilot_text(status))
        elif state == "starting":
            yield unknown(name, reason or "starting", "ask again in some seconds")
        else:
            text = reason or state
            advice = _WAITING.get(name, LOG)
            yield fault(name, text, advice) if name == "autopilot" else warning(name, text, advice)


def _autopilot_text(status: StatusBody) -> str:
    vehicle = status["vehicle"]
    return f"{vehicle['autopilot'] or 'an autopilot'} {vehicle['firmware'] or 'of unknown version'}"


def _flown(facts: Facts) -> Iterator[Check]:
    status = _status(facts)
    if status is None or (why := status["vehicle"]["not_flown"]) is None:
        return
    if why in NOT_KNOWN_YET:
        yield unknown("vehicle type", why, "ask again in some seconds")
    else:
        yield fault("vehicle type", f"no flight commands: {why}", "docs/safety.md, Which vehicles are flown")


def _silence(facts: Facts) -> Iterator[Check]:
    status = _status(facts)
    if status is None or not status["vehicle"]["connected"] or status["vehicle"]["not_flown"]:
        return
    silence = status["vehicle"]["silence"]
    if not silence["warning"]:
        yield ok("silence", silence["text"])
    else:
        px4 = status["vehicle"]["autopilot"] == "PX4"
        set_it = "COM_OBL_RC_ACT 5 (hold) or 3 (return)" if px4 else "GUID_TIMEOUT 1"
        yield warning("silence", silence["text"], f"set {set_it}; docs/safety.md, What silence does")


def _link(facts: Facts) -> Iterator[Check]:
    status = _status(facts)
    if status is None or not status["vehicle"]["connected"]:
        return
    vehicle, received = status["vehicle"], status["vehicle"]["reception"]
    if vehicle["failsafe"]:
        yield fault("link", "the autopilot is in a failsafe", "read its texts: companion status")
    total = received["frames"] + received["lost"]
    lost = received["lost"] / total if total else 0.0
    skipped = received["skipped_bytes"]
    if lost > _LOST:
        yield warning(
            "link",
            f"{lost:.0%} of the autopilot's frames are lost ({received['lost']} of {total}), {skipped} bytes "
            "in no frame",
            "wiring, a slow baud rate (SER_TEL2_BAUD 921600), or a second reader: companion doctor names it",
        )
    if vehicle["missing_streams"]:
        advice = (
            "PX4: MAV_1_MODE 2 (Onboard), MAV_1_RATE 0, SER_TEL2_BAUD 921600; ArduPilot: SERIAL2_BAUD 921"
        )
        if vehicle["missing_streams"] == ["HOME_POSITION"]:
            advice = "the autopilot has no home yet: wait for its position"
        yield warning(
            "link",
            f"arrive at less than half their rate: {', '.join(vehicle['missing_streams'])}",
            advice,
        )
    if lost <= _LOST and not vehicle["missing_streams"] and not vehicle["failsafe"]:
        yield ok("link", f"{received['frames']} frames, {lost:.1%} lost; all streams at their rate")


def _commanders(facts: Facts) -> Iterator[Check]:
    status, service = _status(facts), facts.service
    if status is None or service is None:
        return
    for other in status["vehicle"]["other_commanders"]:
        named = f"{other['identity']} by {other['via']}, up for {duration_text(other['uptime_s'])}"
        command = ", in command" if other["in_command"] else ""
        advice = (
            "give each service its own vehicle.name" if other["via"] == "zenoh" else "stop one of the two"
        )
        yield fault("other commander", f"another program commands this vehicle: {named}{command}", advice)

    # Two services of one name have different `service` in what they publish.
    names = {each["service"] for each in service.statuses}
    if len(names) > 1 and not status["vehicle"]["other_commanders"]:
        found = f"{len(names)} services publish as {service.vehicle!r}: {', '.join(sorted(names))}"
        yield fault("other commander", found, "give each service its own vehicle.name")


def _clocks(facts: Facts) -> Iterator[Check]:
    status, service = _status(facts), facts.service
    if status is None or service is None or not status["vehicle"]["connected"]:
        return
    if service.state is None:
        yield unknown("time synchronization", "the topic vehicle was not received")
        return
    if (error_ns := service.state["boot_error_ns"]) is None:
        yield warning(
            "time synchronization",
            "the autopilot does not answer TIMESYNC: positions have the time of their arrival",
            "the link must carry both directions; a simulation that is not in real time has none",
        )
        return
    error_ms = error_ns / 1e6
    found = f"error of the autopilot's clock at most {error_ms:.1f} ms"
    if error_ms > _SYNC_ERROR_MS:
        yield warning("time synchronization", found, "a slow link: raise its baud rate")
    else:
        yield ok("time synchronization", found)


def _cameras(facts: Facts) -> Iterator[Check]:
    status, service = _status(facts), facts.service
    if status is None or service is None:
        return
    parts = {part["name"]: part for part in status["parts"]}
    for name, camera in cameras_of(status).items():
        label = camera_label(name)
        part = parts.get(label)
        if part is None:
            continue
        if part["state"] == "starting":
            yield unknown(label, part["reason"] or "starting", "ask again in some seconds")
        elif part["state"] not in _UP:
            yield fault(label, part["reason"] or camera["problem"] or part["state"], LOG)
        elif part["state"] == "finished":
            yield ok(label, part["reason"])
        else:
            yield _camera(label, name, camera, facts)


def _camera(label: str, name: str | None, camera: StatusCameraBody, facts: Facts) -> Check:
    service, status = facts.service, _status(facts)
    assert service is not None
    assert status is not None
    frame_rate_hz = _frame_rate_hz(name, service)
    known = facts.settings_known and (name is None or name in facts.settings.cameras)
    source = facts.settings.of_camera(name).source if known else None
    wanted_hz = None if source is None else source.rate_hz
    age_s, most_s = camera["age_s"], facts.settings.guidance.perception_max_age_s
    text = f"{camera['rate_hz']:.1f} results/s" + (
        "" if frame_rate_hz is None else f" of {frame_rate_hz:.1f} frames/s"
    )
    for why in status["unhealthy"]:
        if why.startswith(f"{label}: "):
            return fault(label, why.removeprefix(f"{label}: "), LOG)
    if age_s is None or age_s > most_s:
        newest = "no result yet" if age_s is None else f"the newest result is {age_s:.1f} s old"
        return warning(
            label, f"{newest}; guidance uses {most_s:g} s at most", "a faster network, see detector"
        )
    if (slow := slow_camera(label, text, frame_rate_hz, wanted_hz)) is not None:
        return slow
    # A simulated camera has no noise: its image stays the same while nothing moves.
    camera_of_ours = source is not None and not source.uri.startswith("shm://")
    if camera_of_ours and (repeated := _repeated(name, service)) > _REPEATED:
        return warning(label, f"{repeated:.0%} of its images repeat the one before", "restart the camera")
    return ok(label, text)


def slow_camera(label: str, text: str, rate_hz: float | None, wanted_hz: float | None) -> Check | None:
    """Return a warning if a camera delivers fewer frames than were requested. None: it does not."""
    if wanted_hz is None or rate_hz is None or rate_hz >= _RATE_SHARE * wanted_hz:
        return None
    advice = "more light or a fixed source.exposure_us, source.pixel_format MJPG, another USB port"
    return warning(label, f"{text}; source.rate_hz is {wanted_hz:g}", advice)


def _detectors(facts: Facts) -> Iterator[Check]:
    """Compare the time of each network with the time between frames."""
    status, service = _status(facts), facts.service
    if status is None or service is None:
        return
    for name, camera in cameras_of(status).items():
        if camera["state"] == "running" and all(stage in camera["timing_p50_ms"] for stage in _STAGES):
            label = "detector" if name is None else f"detector {name}"
            yield _detector(label, camera, _frame_rate_hz(name, service))


def _detector(label: str, camera: StatusCameraBody, frame_rate_hz: float | None) -> Check:
    times = camera["timing_p50_ms"]
    took_ms = sum(times[stage] for stage in _STAGES)
    what = f"{camera['model']} on {camera['runtime']} ({camera['precision']}): {took_ms:.0f} ms a frame"
    if frame_rate_hz is not None and frame_rate_hz > 0 and took_ms > 1000 / frame_rate_hz:
        return warning(
            label,
            f"{what}; frames come every {1000 / frame_rate_hz:.0f} ms, so some are not processed",
            'detector.image_size = 320, detector.runtime = "auto", or a smaller model',
        )
    return ok(label, what)


def duration_text(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


def _frame_rate_hz(name: str | None, service: Service) -> float | None:
    """Return the rate of frames between the first and the last status of one service."""
    if (pair := _first_and_last(name, service)) is None:
        return None
    seconds = (service.statuses[-1]["stamp_ns"] - service.statuses[0]["stamp_ns"]) / 1e9
    return (pair[1]["frames"] - pair[0]["frames"]) / seconds


def _repeated(name: str | None, service: Service) -> float:
    """Return the share of frames between them that repeat the one before."""
    if (pair := _first_and_last(name, service)) is None:
        return 0.0
    before, after = (max(each["frames_repeated"].values(), default=0) for each in pair)
    return (after - before) / max(pair[1]["frames"] - pair[0]["frames"], 1)


def _first_and_last(name: str | None, service: Service) -> tuple[StatusCameraBody, StatusCameraBody] | None:
    """Return a camera in the first and in the last status; None: not of the same process."""
    if len(service.statuses) < 2:
        return None
    first, last = service.statuses[0], service.statuses[-1]
    before, after = cameras_of(first).get(name), cameras_of(last).get(name)
    if before is None or after is None or first["service"] != last["service"]:
        return None
    return (before, after) if before["pid"] == after["pid"] else None


def _gimbal(facts: Facts) -> Iterator[Check]:
    status = _status(facts)
    if status is not None and (gimbal := status["gimbal"]) is not None and gimbal["problem"]:
        yield warning("gimbal", gimbal["problem"], "docs/how-to/gimbals.md")


def _losses(facts: Facts) -> Iterator[Check]:
    if (status := _status(facts)) is None:
        return
    ignored = {topic: count for topic, count in status["bus"]["ignored"].items() if count}
    if ignored:
        text = ", ".join(f"{count} of {topic}" for topic, count in ignored.items())
        yield warning("messages", f"not valid, too large or too many: {text}", "correct their sender")
    if refused := status["bus"]["refused_commands"]:
        yield warning(
            "messages", f"{refused} commands above 20 a second were refused", "correct their sender"
        )
    if dropped := status["log"]["dropped_lines"]:
        yield warning("messages", f"{dropped} lines of the log were lost: its reader stalled", "a free disk")


CHECKS = (
    CheckKind("service", "no service, one that hangs or refuses, several", _service),
    CheckKind("autopilot", "missing parts, with the service's reason: autopilot, zenoh, recorder", _parts),
    CheckKind("vehicle type", "a vehicle that gets no flight commands", _flown),
    CheckKind("silence", "an autopilot that sinks, drifts or flies on when setpoints stop", _silence),
    CheckKind("link", "lost frames, bytes that are not MAVLink, slow streams, a failsafe", _link),
    CheckKind("other commander", "another program or service in command", _commanders),
    CheckKind("time synchronization", "no answer to TIMESYNC, or a large error", _clocks),
    CheckKind("camera", "no frames, old results, a rate below `source.rate_hz`, a frozen image", _cameras),
    CheckKind("detector", "a network that is slower than the camera", _detectors),
    CheckKind("gimbal", "no attitude, or no control", _gimbal),
    CheckKind("messages", "refused messages and commands, lost lines of the log", _losses),
)
