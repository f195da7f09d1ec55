"""The demonstration in lockstep: the same core and mission as `companion demo`, over many seeds."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from companion.bench.demo_flight import DemoFlight, demos_summary, fly_demo
from companion.cli.commands import app


def test_demonstration_flies_on_the_command_line() -> None:
    result = CliRunner().invoke(app, ["demo", "--seeds", "3", "--synthetic", "--json"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert (figures["flights"], figures["successes"]) == (1, 1)
    (flight,) = figures["seeds"]
    assert flight["success"], flight["failure"]
    assert flight["hold_range_m"] == pytest.approx(5.0, abs=0.5)
    assert figures == demos_summary([DemoFlight(**flight)])


@pytest.mark.slow
def test_same_seed_gives_the_same_demonstration() -> None:
    assert fly_demo(3, synthetic=True) == fly_demo(3, synthetic=True)


def test_wrong_seeds_are_exit_code_2() -> None:
    assert CliRunner().invoke(app, ["demo", "--seeds", "x"]).exit_code == 2
