"""The demonstration in lockstep: the same core and mission as `companion demo`, over many seeds."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from companion.bench.demo_flight import demos_summary, fly_demo, seeds_of
from companion.cli.commands import app


def test_seeds_are_numbers_and_ranges() -> None:
    assert seeds_of("1..3, 7,9..9") == [1, 2, 3, 7, 9]
    for wrong in ("", "a", "3..1", "-1", "1..b"):
        with pytest.raises(ValueError, match="seeds"):
            seeds_of(wrong)


def test_the_same_seed_gives_the_same_flight() -> None:
    flight = fly_demo(3, synthetic=True)
    assert flight == fly_demo(3, synthetic=True)
    assert flight.success, flight.failure
    assert flight.hold_range_m == pytest.approx(5.0, abs=0.5)
    figures = demos_summary([flight])
    assert (figures["flights"], figures["successes"]) == (1, 1)
    assert json.loads(json.dumps(figures)) == figures


def test_the_rendered_demonstration_finds_the_car_and_lands() -> None:
    flight = fly_demo(3)
    assert flight.success, flight.failure
    assert flight.confirmed == "car"


def test_the_command_prints_json_and_fails_with_a_failure() -> None:
    result = CliRunner().invoke(app, ["demo", "--seeds", "3", "--synthetic", "--json"])
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert [flight["seed"] for flight in figures["seeds"]] == [3]
    wrong = CliRunner().invoke(app, ["demo", "--seeds", "x"])
    assert wrong.exit_code == 2
