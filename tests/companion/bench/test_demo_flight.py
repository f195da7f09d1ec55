"""The demonstration in lockstep: the same core and mission as `companion demo`, over many seeds."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from companion.bench.demo_flight import demos_summary, fly_demo
from companion.cli.commands import app


def test_the_same_seed_gives_the_same_flight_on_the_command_line() -> None:
    flight = fly_demo(3, synthetic=True)
    assert flight.success, flight.failure
    assert flight.hold_range_m == pytest.approx(5.0, abs=0.5)
    figures = demos_summary([flight])
    assert (figures["flights"], figures["successes"]) == (1, 1)
    result = CliRunner().invoke(app, ["demo", "--seeds", "3", "--synthetic", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == figures


def test_wrong_seeds_are_exit_code_2() -> None:
    assert CliRunner().invoke(app, ["demo", "--seeds", "x"]).exit_code == 2
