"""Flight campaigns: one flight over many seeds, in lockstep with the simulated vehicle, as a table.

    python -m benchmarks.flights approach-depth --runs 40 --seed 100 --processes 2 [--rendered] [--json]

A flight is a module `benchmarks/flights_NAME.py` with a function `run(seed: int) -> FlightResult`; it is
found by that name (`_` is written `-`). The same seed gives the same flight, every time. One whose `run`
takes `rendered` as well is flown in two ways: with synthetic detections, or with the rendered camera and the
real perception.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import pkgutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from companion.simulation.campaign import ClusterError, SeedError, map_seeds, seeds_of


@dataclass(frozen=True, slots=True)
class FlightResult:
    """One flight.

    Attributes:
        success: it did what the behaviour promises.
        values: figures by name; the unit stands in the name (`range_error_m`). NaN where there is none.
        reason: how it ended, in words.
    """

    seed: int
    success: bool
    values: dict[str, float] = field(default_factory=dict)
    reason: str = ""


Flight = Callable[..., FlightResult]

_PREFIX = "flights_"
_FIGURES = ("mean", "min", "p5", "p50", "p95", "max")


class UnknownFlightError(LookupError):
    """There is no such flight. The message names those that there are."""


def flights() -> tuple[str, ...]:
    """What can be flown, by name, in order."""
    package = importlib.import_module("benchmarks")
    modules = (module.name for module in pkgutil.iter_modules(package.__path__))
    return tuple(
        sorted(name.removeprefix(_PREFIX).replace("_", "-") for name in modules if name.startswith(_PREFIX))
    )


def flight_named(name: str) -> Flight:
    """The function that flies it. Raises UnknownFlightError."""
    known = flights()
    if name not in known:
        raise UnknownFlightError(f"no flight is called {name!r}; there are: {', '.join(known) or 'none'}")
    flight: Flight = importlib.import_module(f"benchmarks.{_PREFIX}{name.replace('-', '_')}").run
    return flight


def fly(
    name: str, seeds: Sequence[int], processes: int = 1, *, ray: str | None = None, rendered: bool = False
) -> Iterator[FlightResult]:
    """Fly it once with each seed, the results in the seeds' order; see `map_seeds`.

    Args:
        rendered: with the rendered camera and the real perception.

    Raises:
        UnknownFlightError: also of one that has no rendered camera.
    """
    flight = flight_named(name)
    if rendered and "rendered" not in inspect.signature(flight).parameters:
        raise UnknownFlightError(f"{name} has no flights with a rendered camera")
    return map_seeds(
        partial(flight, rendered=True) if rendered else flight, seeds, processes=processes, ray=ray
    )


def summary(name: str, results: Sequence[FlightResult]) -> dict[str, Any]:
    """Success rate, mean and spread of each value, and what went wrong; plain values, ready for JSON.

    Raises:
        ValueError: there are no results.
    """
    if not results:
        raise ValueError(f"{name}: no flights were flown")
    names = dict.fromkeys(key for result in results for key in result.values)
    values = {}
    for key in names:
        numbers = np.array([result.values.get(key, np.nan) for result in results], np.float64)
        known = numbers[np.isfinite(numbers)]
        figures = (
            (known.mean(), known.min(), *np.percentile(known, (5, 50, 95)), known.max())
            if len(known)
            else (np.nan,) * len(_FIGURES)
        )
        values[key] = {
            **{name: float(value) for name, value in zip(_FIGURES, figures, strict=True)},
            "flights": len(known),
        }
    return {
        "flight": name,
        "runs": len(results),
        "successes": sum(result.success for result in results),
        "success_rate": sum(result.success for result in results) / len(results),
        "values": values,
        "failures": {result.seed: result.reason for result in results if not result.success},
    }


def flights_table(figures: dict[str, Any]) -> Table:
    """The same for people."""
    rate, runs = figures["success_rate"], figures["runs"]
    table = Table(title=f"{figures['flight']}: {figures['successes']} of {runs} flights, {rate:.1%}")
    table.add_column("value")
    for heading in _FIGURES:
        table.add_column(heading, justify="right")
    for name, spread in figures["values"].items():
        table.add_row(name, *(f"{spread[key]:.3g}" for key in _FIGURES))
    return table


def add_workers(parser: argparse.ArgumentParser) -> None:
    """The options of `map_seeds`."""
    workers = parser.add_mutually_exclusive_group()
    workers.add_argument("--processes", type=_count, default=1, help="seeds at once")
    workers.add_argument("--ray", metavar="HOST:PORT", help="run on this Ray cluster (extra learn)")


def add_seeds(parser: argparse.ArgumentParser, default: str) -> None:
    """The option `--seeds`, and those of `map_seeds`."""
    parser.add_argument("--seeds", type=_seeds, default=default, help="as 1..10, or 3,7,9..12")
    add_workers(parser)


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number from 1, got {text!r}")
    return int(text)


def _seeds(text: str) -> list[int]:
    try:
        return seeds_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns the exit code: 2 for no such flight or cluster, or a seed that fails."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.flights", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("name", help=f"one of: {', '.join(flights())}")
    parser.add_argument("--runs", type=int, default=100, help="flights, one per seed")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    add_workers(parser)
    parser.add_argument("--rendered", action="store_true", help="the rendered camera with the real detector")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    given = parser.parse_args(arguments)
    seeds = range(given.seed, given.seed + given.runs)
    try:
        results = fly(given.name, seeds, given.processes, ray=given.ray, rendered=given.rendered)
        figures = summary(given.name, list(results))
    except (UnknownFlightError, ClusterError, SeedError) as error:
        print(error, file=sys.stderr)
        return 2
    if given.json:
        print(json.dumps(figures))
        return 0
    Console().print(flights_table(figures))
    for failed, reason in figures["failures"].items():
        print(f"seed {failed}: {reason}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
