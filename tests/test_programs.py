"""What tests are left out where something is missing, and that CI leaves out none that could run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.programs import MAKE, NEEDS, left_out

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("missing", NEEDS)
def test_line_names_what_is_left_out_and_how_to_get_it(missing: str) -> None:
    line = left_out({name: need._replace(here=name != missing) for name, need in NEEDS.items()})
    assert "\n" not in line
    assert NEEDS[missing].tests in line
    assert NEEDS[missing].get in line
    assert not any(need.tests in line for name, need in NEEDS.items() if name != missing)


def test_nothing_is_said_where_all_is_here() -> None:
    assert left_out({name: need._replace(here=True) for name, need in NEEDS.items()}) == ""


def test_whole_line_is_one_line() -> None:
    line = left_out({name: need._replace(here=False) for name, need in NEEDS.items()})
    assert "\n" not in line
    assert line.count(MAKE) == 1


@pytest.mark.parametrize(("programs", "outcome"), [("", "skipped"), ("required", "errors")])
def test_missing_program_skips_its_tests_and_fails_them_in_ci(programs: str, outcome: str) -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            "tests/companion/dashboard/test_outcome.py",
        ],
        cwd=ROOT,
        env={"PATH": "", "COMPANION_TEST_PROGRAMS": programs},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert re.fullmatch(rf"=+ \d+ {outcome} in .*", done.stdout.splitlines()[-1]), done.stdout + done.stderr
    assert f"no node: {MAKE}" in done.stdout
