"""The inputs and outputs of guidance as they are recorded, one of each per step.

Together with guidance's options, a `RecordedStep` is everything that `Guidance.step` depends on. A behaviour
has no encoding: recorded is what it was built from, its command's text and `CommandSource`. With the recorded
images it is also what the steering camera's targets depend on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from companion.guidance.behaviour import Behaviour
from companion.guidance.command import BuildContext
from companion.guidance.core import GuidanceOptions
from companion.guidance.gimbal.controller import GimbalMounting
from companion.guidance.grammar import parse
from companion.guidance.interface import CommandInput, CommandSource, GuidanceInput, GuidanceOutput
from companion.guidance.objects.from_detections import HistorySamples
from companion.guidance.objects.tracked_object import GimbalGoal
from companion.recording.encoding import decode, encode, layout_of


@dataclass(frozen=True, slots=True)
class RecordedCommand:
    """A `CommandInput` without its behaviour.

    Attributes:
        source: None for a command that only points the gimbal, and for a behaviour not built from a text.
    """

    identifier: int
    text: str
    aim: GimbalGoal | None
    endless: bool
    mode_changes: int | None
    source: CommandSource | None
    received_ns: int | None


@dataclass(frozen=True, slots=True)
class StepContext:
    """What is recorded of a step besides its input.

    Attributes:
        mounting: which cameras the gimbal carries; a camera's calibration may arrive during a flight.
        camera: the steering camera's section `camera` as JSON, with the camera's own calibration.
        samples: of the vehicle's pose since the previous step.
    """

    mounting: GimbalMounting
    camera: str
    samples: HistorySamples


@dataclass(frozen=True, slots=True)
class RecordedStep:
    """The input of one step.

    Attributes:
        step: counted from the start of the service; a gap means lost steps.
        inputs: without commands.
    """

    step: int
    now_ns: int
    context: StepContext
    commands: tuple[RecordedCommand, ...]
    inputs: GuidanceInput


# Recordings with another layout were made by a version whose types differ; they cannot be replayed.
LAYOUT = layout_of(RecordedStep, GuidanceOutput, GuidanceOptions)


def input_record(step: int, now_ns: int, context: StepContext, inputs: GuidanceInput) -> dict[str, Any]:
    """Encode the input of one step, as JSON-able data."""
    commands = tuple(
        RecordedCommand(
            command.identifier,
            command.text,
            command.aim,
            command.endless,
            command.mode_changes,
            command.source,
            command.received_ns,
        )
        for command in inputs.commands
    )
    data: dict[str, Any] = encode(RecordedStep, RecordedStep(step, now_ns, context, commands, inputs))
    return data


def output_record(step: int, now_ns: int, output: GuidanceOutput) -> dict[str, Any]:
    """Encode the output of one step, as JSON-able data."""
    return {"step": step, "now_ns": now_ns, **encode(GuidanceOutput, output)}


def read_step(data: Any) -> RecordedStep:
    """Decode `input_record`. Raises DecodeError."""
    return decode(RecordedStep, data)


def inputs_of(recorded: RecordedStep, check_requirements: Callable[[Behaviour], str | None]) -> GuidanceInput:
    """Return the input with its commands, whose behaviours are built again.

    Args:
        check_requirements: of the guidance that the input is for.

    Raises:
        GrammarError: a command is unknown here (a plug-in's), or its behaviour was not built from a text.
    """
    commands = tuple(_command(command, check_requirements) for command in recorded.commands)
    return replace(recorded.inputs, commands=commands)


def _command(
    recorded: RecordedCommand, check_requirements: Callable[[Behaviour], str | None]
) -> CommandInput:
    source, behaviour = recorded.source, None
    if recorded.aim is None:
        attached = source or CommandSource("", None, None)
        context = BuildContext(
            attached.footprint, attached.class_names, attached.attachment, check_requirements
        )
        behaviour = parse(recorded.text, attached.class_names).build(context)
    return CommandInput(
        recorded.identifier,
        recorded.text,
        behaviour,
        recorded.aim,
        recorded.endless,
        recorded.mode_changes,
        source,
        recorded.received_ns,
    )
