"""Mission files: parsing and errors."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.missions.mission_file import (
    MISSIONS_FOLDER,
    MissionError,
    describe,
    find_mission,
    plan_from,
    read_mission,
)
from companion.guidance.missions.sequence import ABORT, END, LAND, RTL

NAMES = ("person", "car", "traffic light")
DOCUMENT = Path(__file__).parents[3] / "docs" / "how-to" / "missions.md"


def problems(text: str, names: tuple[str, ...] | None = NAMES) -> list[str]:
    with pytest.raises(MissionError) as caught:
        plan_from(text, "m.toml", names)
    return list(caught.value.problems)


def test_demo_mission_is_valid() -> None:
    plan = plan_from(read_mission(find_mission("demo")), "demo", NAMES)
    assert [step.command.split()[0] for step in plan.steps] == ["takeoff", "seek", "approach", "hold", "rtl"]
    # What is lost or of an ambiguous class is looked for again, three times at most.
    assert [step.on_failure for step in plan.steps] == [RTL, RTL, 1, RTL, ABORT]
    assert plan.steps[1].visits == 3
    assert [step.on_success for step in plan.steps] == [1, 2, 3, 4, END]


@pytest.mark.parametrize("path", sorted(MISSIONS_FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_bundled_missions_are_valid(path: Path) -> None:
    assert describe(plan_from(read_mission(path), str(path), NAMES))


def test_missions_in_the_documents_are_valid() -> None:
    blocks = re.findall(r"^```toml\n(.*?)^```", DOCUMENT.read_text(), re.MULTILINE | re.DOTALL)
    missions = [block for block in blocks if "[[step]]" in block]
    assert missions
    for text in missions:
        assert plan_from(text, "missions.md", NAMES).steps


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", "m.toml|at least one"),
        ("step = []", "m.toml|step|at least 1 item"),
        ("[[step]]\nname = 'a'", "m.toml|step 1|do is missing"),
        ("[[step]]\ndo =", "m.toml|invalid TOML"),
        ("nam = 'x'\n[[step]]\ndo = 'land'", "m.toml|'nam'|name?"),
        (
            "[[step]]\ndo = 'land'\non_fail = 'rtl'",
            "m.toml|step 1|'on_fail'|on_failure",
        ),
        ("[[step]]\ndo = 'takeof 5'", "m.toml|step 1|'takeof'|takeoff?"),
        ("[[step]]\ndo = 'takeoff 500'", "m.toml|step 1|altitude|1 to 50 m"),
        ("[[step]]\nname = 'find'\ndo = 'seek zebra'", "m.toml|step 1 (find)|'zebra'"),
        ("[[step]]\ndo = 'hold'", "m.toml|step 1|'hold'|timeout_s"),
        ("[[step]]\ndo = 'mission demo'", "m.toml|step 1|another mission"),
        ("[[step]]\ndo = 'land'\ntimeout_s = 0", "m.toml|step 1|timeout_s|greater than 0"),
        ("[[step]]\ndo = 'land'\ntimeout_s = nan", "m.toml|step 1|timeout_s"),
        (
            "[[step]]\ndo = 'land'\ntimeout_s = '5'",
            "m.toml|step 1|timeout_s|valid number",
        ),
        ("[[step]]\ndo = 'land'\nrepeat = 0", "m.toml|step 1|repeat|greater than or equal"),
        ("[[step]]\ndo = 'land'\non_success = 'home'", "m.toml|step 1|on_success|'home'"),
        ("[[step]]\nname = 'rtl'\ndo = 'rtl'", "m.toml|step 1 (rtl)|'rtl'|reserved"),
        (
            "[[step]]\nname = 'a'\ndo = 'hold 1'\n[[step]]\nname = 'a'\ndo = 'land'",
            "m.toml|step 2 (a)|by step 1",
        ),
        (
            "[[step]]\ndo = 'land'\non_success = 'end'\n[[step]]\nname = 'x'\ndo = 'land'",
            "m.toml|step 2 (x)|unreachable",
        ),
        (
            "[[step]]\nname = 'a'\ndo = 'hold 1'\non_success = 'a'",
            "m.toml|step 1 (a)|loop without exit",
        ),
    ],
)
def test_problem_is_one_line_with_file_and_step(text: str, parts: str) -> None:
    [line] = problems(text)
    assert all(part in line for part in parts.split("|")), line
    assert "\n" not in line


LOOP = """
[[step]]
name = "a"
do = "hold 1"
{exit}
[[step]]
do = "hold 2"
on_success = "a"
{more}
"""
OUT = 'on_failure = "continue"\n[[step]]\nname = "out"\ndo = "land"'


@pytest.mark.parametrize(
    "exit_line",
    ["visits = 3", "on_failure = 'rtl'", "on_failure = 'land'", "on_failure = 'end'", "on_failure = 'out'"],
)
def test_loop_with_an_exit_is_allowed(exit_line: str) -> None:
    assert plan_from(LOOP.format(exit=exit_line, more=OUT if "out" in exit_line else ""), "m.toml").steps


def test_class_takes_the_detectors_spelling() -> None:
    plan = plan_from("[[step]]\ndo = 'seek Traffic_Light'", "m.toml", NAMES)
    assert plan.steps[0].make().class_names == ("traffic light",)


words = st.sampled_from(["continue", "end", "abort", "rtl", "land", "s0", "s1", "s2", "s3"])


@given(st.lists(st.tuples(words, words, st.booleans()), min_size=1, max_size=4))
def test_every_accepted_plan_ends(
    steps: list[tuple[str, str, bool]],
) -> None:
    """From every step some branch leads to an end, and every step is reachable."""
    text = "".join(
        f"[[step]]\nname = 's{index}'\ndo = 'hold 1'\non_success = '{success}'\non_failure = '{failure}'\n"
        + ("visits = 2\n" if limited else "")
        for index, (success, failure, limited) in enumerate(steps)
    )
    try:
        plan = plan_from(text, "m.toml")
    except MissionError:
        return
    reached, waiting = {0}, [0]
    while waiting:
        step = plan.steps[waiting.pop()]
        fresh = {f for f in (step.on_success, step.on_failure) if isinstance(f, int)} - reached
        reached |= fresh
        waiting += fresh
    assert reached == set(range(len(steps)))
    ending = {index for index, step in enumerate(plan.steps) if step.visits is not None}
    for _ in plan.steps:
        ending |= {
            index
            for index, step in enumerate(plan.steps)
            if {step.on_success, step.on_failure} & {END, RTL, LAND, ABORT, *ending}
        }
    assert ending == reached


@given(st.text(max_size=200))
def test_any_text_is_a_mission_or_an_error_with_file_name(text: str) -> None:
    problems_found: tuple[str, ...] = ()
    try:
        plan_from(text, "m.toml")
    except MissionError as error:
        problems_found = error.problems
    assert all(line.startswith("m.toml: ") for line in problems_found)


def test_mission_is_found_by_path_or_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "own.toml"
    own.write_text("[[step]]\ndo = 'land'\n")
    assert find_mission(str(own)) == own
    assert find_mission("own").resolve() == own
    assert find_mission("demo") == MISSIONS_FOLDER / "demo.toml"
    with pytest.raises(MissionError, match=r"'nowhere'.*demo"):
        find_mission("nowhere")


@pytest.mark.parametrize("name", ["x" * 300, "\0", ".", "/", "a/" * 3000])
def test_impossible_file_name_is_a_one_line_error(name: str) -> None:
    with pytest.raises(MissionError) as error:
        find_mission(name)
    assert "\n" not in str(error.value)


def test_faults_of_tables_names_branches_and_graph_come_at_once() -> None:
    text = """
timeout_s = -2
[[step]]
name = "a"
do = "takeof 5"
timeout_s = -3
[[step]]
name = "a"
do = "goto 1"
on_success = "nowhere"
[[step]]
do = "mission other"
on_success = "end"
[[step]]
name = "loop"
do = "hold 1"
on_success = "loop"
"""
    found = [line.removeprefix("m.toml: ") for line in problems(text.replace('"nowhere"', '"abort"'))]
    assert [line.partition(" (")[0].partition(":")[0] for line in found] == [
        "timeout_s",
        "step 1",  # timeout_s
        "step 2",  # the name
        "step 1",  # the command
        "step 2",  # the command
        "step 3",  # a mission
        "step 4",  # a loop without exit
    ]
    # Where an unknown branch leads is not known: nothing is called unreachable because of it.
    both = [line.removeprefix("m.toml: ") for line in problems(text)]
    unknown = min(set(both) - set(found))
    assert unknown.startswith("step 2 (a): on_success: ")
    assert " 'nowhere'" in unknown
    assert set(found) <= set(both)
    assert len(both) == 8


def test_invalid_value_makes_no_second_error() -> None:
    text = "[[step]]\ndo = 'hold'\ntimeout_s = -1\non_succes = 'b'\n[[step]]\nname = 'b'\ndo = 'land'\n"
    assert len(problems(text)) == 2
    text = "[[step]]\ndo = 'hold 1'\non_success = 7\n[[step]]\nname = 'b'\ndo = 8\n[[step]]\ndo = 'land'"
    assert len(problems(text)) == 2
    assert len(problems("step = [3, {do = 'land', on_success = 'end'}, {do = 'rtl'}]")) == 1
    assert len(problems("[[step]]\ndo = 'hold 1'\n" * 201)) == 1
