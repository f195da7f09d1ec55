"""`companion log replay`: step guidance again over recorded inputs, and compare its outputs.

`Guidance.step` is a function of its inputs: without a change every output is equal, bit for bit, on the same
processor, Python and library versions. With a model its targets are made again from the recorded images
(`replay_perception`). A replay is open-loop: the vehicle of the recording does not react to a changed output,
so the first differences say what a change does, not how the flight would go on.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from companion.guidance.command import GrammarError
from companion.guidance.core import Guidance, GuidanceOptions
from companion.logs import replay_perception
from companion.logs.replay_perception import DetectionReplay, PerceptionReplay
from companion.logs.replay_timeline import TOLERANCES_TEXT, Change, Timeline, setpoint_difference
from companion.recording import RecordingError
from companion.recording.convert import INPUT_CHANNEL, OUTPUT_CHANNEL, RUN_CHANNEL
from companion.recording.encoding import DecodeError, decode, dumps
from companion.recording.files import RecordingReader
from companion.recording.guidance_record import LAYOUT, inputs_of, output_record, read_step
from companion.service.factory import guidance_options
from companion.settings import Settings
from companion.settings.former import without_removed
from companion.settings.reading import ConfigurationError, changed

MAX_LISTED, MAX_LISTED_CHANGES = 10, 25
WINDOW = 1000
"""Steps that an input and its output may be apart in a file."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One differing value of an output. `seconds` since the first replayed step."""

    step: int
    seconds: float
    field: str
    recorded: Any
    replayed: Any


@dataclass(frozen=True, slots=True)
class ChangedSetting:
    """A setting of the replay that differs from the recording's."""

    key: str
    recorded: Any
    replayed: Any


@dataclass
class Replay:
    """The result.

    Attributes:
        digest: SHA-256 of all replayed outputs.
        inexact: why the replay may differ from the flight although nothing was changed, a line each.
        first: the first difference; None: all outputs are equal.
        differing_fields: field of an output → steps in which it differs.
        events_recorded, events_replayed: texts of events that only one side has, the first ten.
        timeline: what differs, by time: targets, events, and setpoints beyond `replay_timeline`'s tolerances.
        detections: how the detections differ; None without a model.
    """

    vehicle: str
    version: str
    changed: list[ChangedSetting]
    steps: int = 0
    seconds: float = 0.0
    commands: int = 0
    digest: str = ""
    inexact: list[str] = field(default_factory=list)
    first: Difference | None = None
    differing_steps: int = 0
    differing_fields: dict[str, int] = field(default_factory=dict)
    events_recorded: list[str] = field(default_factory=list)
    events_replayed: list[str] = field(default_factory=list)
    timeline: list[Change] = field(default_factory=list)
    detections: DetectionReplay | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON-able data."""
        return {"identical": not self.differing_steps, **asdict(self)}


def replay(paths: Sequence[Path], changes: Mapping[str, str], model: str | None = None) -> Replay:
    """Replay one run of a service.

    Args:
        paths: its files, in order.
        changes: key of `[guidance]` → text, for the replay.
        model: detect and track again with it; None: guidance gets the recorded targets.

    Raises:
        RecordingError: not a recording of this version, without steps of guidance, or without usable images.
        ConfigurationError: an invalid change, or one that guidance does not depend on.
        ValueError: the model cannot be loaded.
    """
    run = _run_of(paths)
    if run["layout"] != LAYOUT:
        raise RecordingError(
            f"{paths[0]}: recorded by version {run['version']}, whose guidance has other inputs or outputs; "
            f"replay it with that version"
        )
    try:
        options = decode(GuidanceOptions, run["options"])
        former: list[str] = []
        recorded_settings = Settings.from_json(without_removed(run["settings"], former))
    except (ValueError, LookupError, TypeError, AttributeError) as error:  # also of pydantic
        raise RecordingError(f"{paths[0]}: its settings cannot be read: {_first_line(error)}") from error
    options, changed_settings = _changed_options(options, recorded_settings, changes)
    found = Replay(run["vehicle"], run["version"], changed_settings)
    timeline = Timeline()
    perception = None if model is None else PerceptionReplay(paths, recorded_settings, model, timeline)
    _step_all(paths, Guidance(options), perception, timeline, found)
    if perception is not None:
        found.detections, reasons = perception.result()
        # Guidance alone gets what perception made with them.
        found.inexact += former + reasons
    if not found.steps:
        raise RecordingError(f"{paths[0]}: has no steps of guidance")
    return found


def _run_of(paths: Sequence[Path]) -> dict[str, Any]:
    """Return the description of the run that all files are of."""
    runs: dict[str, dict[str, Any]] = {}
    for path in paths:
        for message in RecordingReader(path).messages(RUN_CHANNEL):
            run = _json(path, message.data)
            runs[run["service"]] = run
            break
        else:
            raise RecordingError(f"{path}: not a recording of the service: it has no message on 'run'")
    if len(runs) > 1:
        raise RecordingError(f"{len(runs)} runs of the service: replay the files of one")
    return next(iter(runs.values()))


def _changed_options(
    options: GuidanceOptions, recorded: Settings, changes: Mapping[str, str]
) -> tuple[GuidanceOptions, list[ChangedSetting]]:
    before = guidance_options(recorded)
    listed = []
    for key, text in changes.items():
        if not key.startswith("guidance."):
            raise ConfigurationError(f"{key}: only settings of [guidance] can be changed in a replay")
        settings = changed(recorded, {key: text})
        name = key.partition(".")[2]
        old, new = getattr(recorded.guidance, name), getattr(settings.guidance, name)
        after = guidance_options(settings)
        if old != new and after == before:
            raise ConfigurationError(f"{key}: Guidance.step does not depend on it; its inputs are recorded")
        listed.append(ChangedSetting(key, old, new))
    after = guidance_options(changed(recorded, changes))
    different = {
        each.name: getattr(after, each.name)
        for each in fields(GuidanceOptions)
        if getattr(after, each.name) != getattr(before, each.name)
    }
    return replace(options, **different), listed


def _step_all(
    paths: Sequence[Path],
    guidance: Guidance,
    perception: PerceptionReplay | None,
    timeline: Timeline,
    found: Replay,
) -> None:
    digest = hashlib.sha256()
    # By step: replayed outputs and recorded ones that wait for each other; either may come first.
    replayed: dict[int, bytes] = {}
    outputs: dict[int, bytes] = {}
    unrecorded: list[int] = []
    next_step = first_ns = 0
    events: tuple[Counter[str], Counter[str]] = (Counter(), Counter())
    times: tuple[dict[str, list[float]], dict[str, list[float]]] = (defaultdict(list), defaultdict(list))
    differing: Counter[str] = Counter()
    for path, topic, data in _messages(paths, found.inexact):
        record = _json(path, data)
        if topic == INPUT_CHANNEL:
            recorded = _decoded(path, record)
            if recorded.step != next_step:
                found.inexact.append(_gap(next_step, recorded.step, started=found.steps > 0))
            next_step = recorded.step + 1
            first_ns = first_ns or recorded.now_ns
            guidance.gimbal.mounting = recorded.context.mounting
            try:
                inputs = inputs_of(recorded, guidance.check_requirements)
            except GrammarError as error:
                raise RecordingError(f"{path}: step {recorded.step}: {_first_line(error)}") from error
            if perception is not None:
                seconds = round((recorded.now_ns - first_ns) / 1e9, 3)
                inputs = replace(inputs, **perception.update(recorded, seconds))
            output = guidance.step(recorded.now_ns, inputs)
            text = dumps(output_record(recorded.step, recorded.now_ns, output))
            digest.update(text)
            step = recorded.step
            replayed[step] = text
            found.steps += 1
            found.commands += len(inputs.commands)
            found.seconds = round((recorded.now_ns - first_ns) / 1e9, 3)
        else:
            step = record["step"]
            outputs[step] = data
        for waiting in (replayed, outputs):
            if len(waiting) > WINDOW:
                oldest = min(waiting)
                del waiting[oldest]
                if waiting is replayed:
                    unrecorded.append(oldest)
        if step in replayed and step in outputs and (new := replayed.pop(step)) != (old := outputs.pop(step)):
            found.differing_steps += 1
            was, again = json.loads(old), json.loads(new)
            differences = list(_differences(was, again))
            differing.update({name.partition(".")[0].partition("[")[0] for name, _, _ in differences})
            seconds = round((was["now_ns"] - first_ns) / 1e9, 3)
            if found.first is None and differences:
                found.first = Difference(step, seconds, *differences[0])
            for counter, side, times_s in zip(events, (was, again), times, strict=True):
                for event in side["events"]:
                    counter[event["message"]] += 1
                    times_s[event["message"]].append(seconds)
            if (apart := setpoint_difference(was["setpoint"], again["setpoint"])) is not None:
                timeline.add("setpoint", seconds, apart[1], apart[0])
    unrecorded += [step for step in sorted(replayed) if step != next_step - 1]  # the last may be cut
    if unrecorded:
        found.inexact.append(
            f"the outputs of {len(unrecorded)} steps are not recorded, first of {unrecorded[0]}"
        )
    found.digest = digest.hexdigest()
    found.differing_fields = dict(differing.most_common())
    found.events_recorded = list((events[0] - events[1]).elements())[:MAX_LISTED]
    found.events_replayed = list((events[1] - events[0]).elements())[:MAX_LISTED]
    for name, texts, times_s in zip(
        ("recording", "replay"), (found.events_recorded, found.events_replayed), times, strict=True
    ):
        for message in texts:
            timeline.add((name, message), times_s[message].pop(), f"event only in the {name}: {message}")
    found.timeline = timeline.sorted()


def _messages(paths: Sequence[Path], problems: list[str]) -> Iterator[tuple[Path, str, bytes]]:
    for path in paths:
        reader = RecordingReader(path)
        for message in reader.messages(INPUT_CHANNEL, OUTPUT_CHANNEL):
            yield path, message.channel.topic, message.data
        problems += reader.problems


def _gap(expected: int, step: int, *, started: bool) -> str:
    if not started:
        return f"it begins with step {step}: what happened before is not known"
    if step > expected:
        return f"steps {expected} to {step - 1} are missing"
    return f"step {step} follows step {expected - 1}: the files are not in order"


def _decoded(path: Path, record: Any) -> Any:
    try:
        return read_step(record)
    except DecodeError as error:
        raise RecordingError(f"{path}: {_first_line(error)}") from error


def _json(path: Path, data: bytes) -> Any:
    try:
        return json.loads(data)
    except ValueError as error:
        raise RecordingError(f"{path}: not JSON: {error}") from error


def _differences(recorded: Any, replayed: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Field, recorded and replayed value of each difference; the type counts too."""
    if type(recorded) is type(replayed) is dict:
        for key in recorded | replayed:
            inner = f"{name}.{key}" if name else key
            yield from _differences(recorded.get(key), replayed.get(key), inner)
    elif type(recorded) is type(replayed) is list and len(recorded) == len(replayed):
        for index, (old, new) in enumerate(zip(recorded, replayed, strict=True)):
            yield from _differences(old, new, f"{name}[{index}]")
    elif dumps(recorded) != dumps(replayed):  # bit for bit: 0.0 and -0.0 differ
        yield name, recorded, replayed


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


def report(found: Replay) -> Iterator[str]:
    """Return the result as lines for people."""
    yield (
        f"{found.steps} steps, {found.seconds:g} s, {found.commands} commands of {found.vehicle}, "
        f"recorded by version {found.version}"
    )
    yield from (f"not exact: {reason}" for reason in found.inexact)
    for setting in found.changed:
        yield f"changed: {setting.key}: recorded {setting.recorded}, replayed {setting.replayed}"
    if found.detections is not None:
        yield from replay_perception.report(found.detections)
    if not found.differing_steps or found.first is None:
        yield f"all outputs are identical (SHA-256 {found.digest})"
        return
    first = found.first
    yield (
        f"first difference: step {first.step}, {first.seconds:g} s: {first.field}: "
        f"recorded {first.recorded}, replayed {first.replayed}"
    )
    listed = ", ".join(f"{name} in {count}" for name, count in found.differing_fields.items())
    yield f"{found.differing_steps} of {found.steps} steps differ: {listed} (SHA-256 {found.digest})"
    yield "open loop: the recorded vehicle does not react to what differs"
    if not found.timeline:
        yield f"no target or event differs, and no setpoint by more than {TOLERANCES_TEXT}"
        return
    yield f"in order of time, setpoints that differ by more than {TOLERANCES_TEXT}:"
    for change in found.timeline[:MAX_LISTED_CHANGES]:
        until = f" to {change.until_s:g}" if change.until_s > change.seconds else ""
        yield f"{change.seconds:g}{until} s: {change.text}"
    if (more := len(found.timeline) - MAX_LISTED_CHANGES) > 0:
        yield f"{more} more differences: all with --json"
