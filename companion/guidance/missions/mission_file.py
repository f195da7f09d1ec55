"""Mission files: TOML with a table `[[step]]` per step, validated completely before the flight.

name = "find the car"
timeout_s = 600                  # of the whole mission, optional

[[step]]
do = "takeoff 5"                 # any command of the grammar, except another mission
on_failure = "abort"             # or "continue", "rtl", "land", "end", or the name of a step

[[step]]
name = "look"                    # target of branches
do = "seek car"
timeout_s = 60                   # required for an endless command, which then ends with success
visits = 3                       # starting it more often fails the mission
on_success = "continue"          # the next step; after the last one: "end"
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from companion.guidance.behaviour import Behaviour
from companion.guidance.command import (
    NO_CONTEXT,
    BuildContext,
    Command,
    FileName,
    GrammarError,
    behaviour,
)
from companion.guidance.grammar import parse
from companion.guidance.missions.sequence import (
    ABORT,
    CONTINUE,
    END,
    LAND,
    RTL,
    Plan,
    PlannedStep,
    SequenceBehaviour,
)
from companion.guidance.search_pattern import Footprint
from companion.settings.toml_text import parse_toml
from vision.class_names import near_names
from vision.file_kinds import explained, kind_of_text
from vision.text_file import read_text

MISSIONS_FOLDER = Path(__file__).parent
LARGEST_BYTES = 100_000
MOST_STEPS = 200
_ENDS = (END, ABORT, RTL, LAND)
_WORDS = (CONTINUE, *_ENDS)
_Seconds = Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=1, le=1000)]


class MissionError(GrammarError):
    """An invalid mission. `problems` has one line each, with file and step; the text joins them."""

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


@behaviour("mission", "fly the steps of a mission file, with their time-outs and branches")
class Mission(Command):
    takes_attachment = True

    file: Annotated[
        str, FileName("file", "a path on the service's computer, or the name of a bundled mission")
    ]

    def build(self, context: BuildContext) -> Behaviour:
        text = context.attachment
        if len(text.encode()) > LARGEST_BYTES:
            raise MissionError(f"{self.file}: a mission has at most {LARGEST_BYTES} bytes")
        if not text.strip():
            text = self.read_attachment()
        plan = plan_from(text, self.file, context.class_names, context.footprint, context.loop_rate_hz)
        return SequenceBehaviour(plan, context.check_requirements)

    def read_attachment(self) -> str:
        return read_mission(find_mission(self.file))


class StepTable(BaseModel):
    """One `[[step]]` table of the file."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    do: str
    name: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    timeout_s: _Seconds | None = None
    repeat: _Count = 1
    visits: _Count | None = None
    on_success: str = CONTINUE
    on_failure: str = ABORT


class MissionTable(BaseModel):
    """The whole file."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: Annotated[str, Field(min_length=1, max_length=60)] | None = None
    description: str = ""
    timeout_s: _Seconds | None = None
    step: Annotated[list[StepTable], Field(min_length=1, max_length=MOST_STEPS)]


# What follows a step: the index of another one, or a word; None: the file is invalid there.
_Branch = int | str | None


def find_mission(name: str) -> Path:
    """Resolve a mission's name: a path, or `NAME.toml` in the working directory or bundled with this package.

    Raises:
        MissionError: not found.
    """
    path = Path(name)
    bundled = sorted(file.stem for file in MISSIONS_FOLDER.glob("*.toml"))
    try:
        for candidate in (path, path.with_name(f"{path.name}.toml")):
            if candidate.is_file():
                return candidate
    except OSError as error:
        raise MissionError(f"invalid mission name {name[:80]!r}: {error.strerror or error}") from error
    except ValueError as error:
        raise MissionError(f"invalid mission name {name[:80]!r}: {error}") from error
    if name in bundled:
        return MISSIONS_FOLDER / f"{name}.toml"
    raise MissionError(
        f"mission {name[:80]!r} not found: no such file in {Path.cwd()}; "
        f"bundled missions: {', '.join(bundled)}"
    )


def read_mission(path: Path) -> str:
    """Read a mission file. Raises MissionError with a line for a person."""
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise MissionError(f"{path}: a mission has at most {LARGEST_BYTES} bytes, this file has {size}")
        return read_text(path)
    except OSError as error:
        raise MissionError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise MissionError(explained(path, f"{path}: {error}")) from error


def plan_from(
    text: str,
    source: str,
    class_names: Sequence[str] | None = None,
    footprint: Footprint | None = None,
    loop_rate_hz: float | None = None,
) -> Plan:
    """Parse and validate a mission.

    Args:
        text: of the file. source: its name, for messages.
        class_names: the detector's classes; None: not known, any is accepted.
        footprint, loop_rate_hz: as of `BuildContext`.

    Raises:
        MissionError: with every problem found: invalid TOML, an unknown key, an invalid command, an unknown
            class or step, an unreachable step, a loop without exit.
    """
    try:
        written = parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        problem = kind_of_text(text) or f"invalid TOML: {error}"
        raise MissionError(f"{source}: {problem}") from error
    problems: list[str] = []
    table = None
    try:
        table = MissionTable.model_validate(written)
        steps = table.step
    except ValidationError as error:
        problems += [_problem_text(source, dict(problem)) for problem in error.errors()]
        steps = _readable_steps(written.get("step"), {problem["loc"][1:3] for problem in error.errors()})
    branches, commands = _read_steps(steps, source, class_names, problems)
    if len(steps) <= MOST_STEPS:  # the time of these grows with the square
        problems += _branch_problems(steps, branches, source)
    if table is None or problems:
        raise MissionError(*problems)
    context = BuildContext(footprint, loop_rate_hz=loop_rate_hz)
    return Plan(
        name=table.name or Path(source).stem,
        steps=tuple(_planned(*step, context) for step in zip(steps, branches, commands, strict=True)),
        way_down=lambda word: parse(word).build(NO_CONTEXT),
        timeout_s=table.timeout_s,
    )


def describe(plan: Plan) -> list[str]:
    """The plan for people, one line per step."""
    lines = [f"mission {plan.name}: {len(plan.steps)} steps"]
    if plan.timeout_s is not None:
        lines[0] += f", {plan.timeout_s:g} s at most"
    for index, step in enumerate(plan.steps):
        words = [f"{index + 1}. {step.command}"]
        if step.title != step.command:
            words.append(f"({step.title})")
        if step.repeat > 1:
            words.append(f"{step.repeat} times")
        if step.timeout_s is not None:
            words.append(f"for {step.timeout_s:g} s" if step.endless else f"within {step.timeout_s:g} s")
        if step.visits is not None:
            words.append(f"at most {step.visits} visits")
        words.append(f"→ {_shown(plan, step.on_success)}; on failure → {_shown(plan, step.on_failure)}")
        lines.append(" ".join(words))
    return lines


def _shown(plan: Plan, follows: int | str) -> str:
    return follows if isinstance(follows, str) else f"{plan.steps[follows].title}"


def _planned(
    table: StepTable, branches: tuple[_Branch, ...], command: Command, context: BuildContext
) -> PlannedStep:
    on_success, on_failure = branches
    assert on_success is not None
    assert on_failure is not None
    return PlannedStep(
        title=table.name or str(command),
        command=str(command),
        make=lambda: command.build(context),
        endless=command.endless,
        timeout_s=table.timeout_s,
        repeat=table.repeat,
        visits=table.visits,
        on_success=on_success,
        on_failure=on_failure,
    )


def _called(index: int, table: StepTable) -> str:
    return f"step {index + 1}" + ("" if table.name is None else f" ({table.name})")


def _problem_text(source: str, problem: dict[str, object]) -> str:
    """One pydantic error as a line: file, step, key, problem."""
    location = problem["loc"]
    assert isinstance(location, tuple)
    words = [source]
    if len(location) >= 2 and location[0] == "step" and isinstance(location[1], int):
        words.append(f"step {location[1] + 1}")
        location = location[2:]
    # In a union the last part only names the member type.
    key = next((str(part) for part in location if isinstance(part, str)), "")
    if problem["type"] == "extra_forbidden":
        known = list(StepTable.model_fields if len(words) == 2 else MissionTable.model_fields)
        return f"{': '.join(words)}: unknown key {key!r}; {near_names(key, known)}"
    if problem["type"] == "missing":
        text = "a mission needs at least one [[step]]" if key == "step" else f"{key} is missing"
        return f"{': '.join(words)}: {text}"
    found = str(problem.get("input"))[:60]
    return f"{': '.join(words)}: {key}: {problem['msg']}, got {found}"


def _readable_steps(written: object, bad: set[tuple[int | str, ...]]) -> list[StepTable]:
    """Return what can be read of the steps of an invalid file, so that all errors are reported together.

    Args:
        written: the file's `step`.
        bad: index and key of each invalid value.
    """
    steps = []
    for index, step in enumerate(written if isinstance(written, list) else []):
        given = step if isinstance(step, dict) else {}
        fields: dict[str, object] = {
            key: given[key] for key in StepTable.model_fields if key in given and (index, key) not in bad
        }
        if any(place[:1] == (index,) for place in bad):
            # What was meant is not known: no error is made of it.
            fields = {"do": None, "on_success": None, "on_failure": None, **fields}
            fields |= {key: 1 for key in ("timeout_s", "visits") if (index, key) in bad}
            if isinstance(given.get("name"), str):
                fields["name"] = given["name"]  # a branch to it is valid
        steps.append(StepTable.model_construct(**fields))  # type: ignore[arg-type]
    return steps


def _read_steps(
    steps: Sequence[StepTable], source: str, class_names: Sequence[str] | None, problems: list[str]
) -> tuple[list[tuple[_Branch, ...]], list[Command]]:
    """Return the branches of every step (on success, on failure), and the valid commands.

    Errors are added to `problems`.
    """
    named: dict[str, int] = {}
    for index, step in enumerate(steps):
        if step.name is None:
            continue
        where = f"{source}: {_called(index, step)}"
        if step.name in _WORDS:
            problems.append(f"{where}: name {step.name!r} is a reserved branch word; choose another")
        elif step.name in named:
            problems.append(f"{where}: name already used by step {named[step.name] + 1}")
        named.setdefault(step.name, index)
    branches, commands = list[tuple[_Branch, ...]](), []
    for index, step in enumerate(steps):
        where = f"{source}: {_called(index, step)}"
        followers: list[_Branch] = []
        for key, word in (("on_success", step.on_success), ("on_failure", step.on_failure)):
            if word == CONTINUE:
                followers.append(index + 1 if index + 1 < len(steps) else END)
            elif word in _ENDS:
                followers.append(word)
            elif word is None or word in named:
                followers.append(named.get(word))
            else:
                known = [*_WORDS, *named]
                problems.append(f"{where}: {key}: unknown step {word!r}; {near_names(word, known)}")
                followers.append(None)
        branches.append(tuple(followers))
        if step.do is None:
            continue
        try:
            command = parse(step.do, class_names)
        except GrammarError as error:
            problems.append(f"{where}: {error}")
            continue
        commands.append(command)
        if isinstance(command, Mission):
            problems.append(f"{where}: a mission cannot start another mission")
        if command.endless and step.timeout_s is None:
            problems.append(f"{where}: {step.do!r} does not end by itself; set timeout_s")
    return branches, commands


def _branch_problems(
    steps: Sequence[StepTable], branches: Sequence[tuple[_Branch, ...]], source: str
) -> list[str]:
    """A line for every unreachable step, and for every loop that only a failure of the mission would end.

    A loop is valid if one of its branches leads out of it, other than to `abort`, or one of its steps limits
    its visits.
    """
    reach = [_reach(branches, index) for index in range(len(steps))]
    reached = {0}.union(*reach[:1])
    problems = [
        f"{source}: {_called(index, step)}: unreachable"
        for index, step in enumerate(steps)
        if index not in reached
    ]
    reported = set[int]()
    for index in range(len(steps)):
        if index in reported or index not in reach[index]:
            continue
        loop = {other for other in reach[index] if index in reach[other]}
        reported |= loop
        exits = {follows for step in loop for follows in branches[step]} - loop - {ABORT}
        if exits or any(steps[step].visits is not None for step in loop):
            continue
        names = ", ".join(_called(step, steps[step]) for step in sorted(loop))
        problems.append(
            f"{source}: {names}: loop without exit; add a branch out of it, or set visits on one of its steps"
        )
    return problems


def _reach(branches: Sequence[tuple[_Branch, ...]], start: int) -> set[int]:
    """All steps that can follow a step: any, where a branch is not known."""
    reached, waiting = set[int](), [start]
    while waiting:
        follows = branches[waiting.pop()]
        known = (
            range(len(branches)) if None in follows else (each for each in follows if isinstance(each, int))
        )
        fresh = set(known) - reached
        reached |= fresh
        waiting += fresh
    return reached
