"""A pytest plugin: a MAVLink vehicle for a test, started, ready to be armed, and stopped afterwards.

>>> def test_my_client_arms_it(vehicle):                              # doctest: +SKIP
...     my_client.connect(vehicle.mavsdk_url)
...     my_client.arm()
...     vehicle.wait_for_event("armed")

`@pytest.mark.vehicle(wind=5, speed=4, parameters={"COM_OF_LOSS_T": 0.5})` sets its options; `make_vehicle`
starts several. If a test fails, each vehicle's log and the traffic on its links are kept and named in the
report.

This module is loaded at the start of every pytest run on a machine that has mavlink_sim; so it imports
nothing but pytest until a test wants a vehicle.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from mavlink_sim.testing import RunningSimulator

LINES_IN_THE_REPORT = 20


@dataclass
class _Flights:
    """The vehicles of one test, and whether that test failed."""

    kept: list[tuple[Path, RunningSimulator]] = field(default_factory=list)
    failed: bool = False


_FLIGHTS = pytest.StashKey[_Flights]()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("mavlink-sim", "a MAVLink vehicle for tests")
    group.addoption(
        "--vehicle-logs",
        metavar="FOLDER",
        type=Path,
        help="Folder for log and traffic of failed tests' vehicles (default: pytest's temporary folder).",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        "vehicle(**options): options of the `vehicle` fixture: those of the command mavlink-sim, "
        "with underscores (wind=5, gusts=0, speed=4, seed=1…), and parameters={NAME: value}",
    )


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, None]:
    outcome = yield
    flights = item.stash.get(_FLIGHTS, None)
    if flights is None:
        return
    report: pytest.TestReport = outcome.get_result()
    if report.failed:
        flights.failed = True
        report.sections += [_section(number, *kept) for number, kept in enumerate(flights.kept, 1)]
    if report.when == "teardown":
        for folder, _ in flights.kept:
            if not flights.failed:
                shutil.rmtree(folder, ignore_errors=True)
        del item.stash[_FLIGHTS]


def _section(number: int, folder: Path, simulator: RunningSimulator) -> tuple[str, str]:
    """The report's section about one vehicle; its log is written here."""
    log = _write_log(folder, simulator)
    output = simulator.transcript[-LINES_IN_THE_REPORT:]
    records = "".join(f"traffic: {path}\n" for path in sorted(folder.glob("*.tlog")))
    return (f"vehicle {number}", f"log:     {log}\n{records}" + "".join(f"{line}\n" for line in output))


def _write_log(folder: Path, simulator: RunningSimulator) -> Path:
    lines = list(simulator.transcript)
    code = simulator.process.poll()
    if code is not None:
        lines.append(f"(its process ended with code {code})")
    log = folder / "vehicle.log"
    log.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    return log


def _marked_options(node: pytest.Item) -> dict[str, Any]:
    """The options of every `vehicle` marker on the test; the nearest wins, parameters are merged."""
    options: dict[str, Any] = {}
    parameters: dict[str, float] = {}
    for marker in reversed(list(node.iter_markers("vehicle"))):
        if marker.args:
            raise pytest.UsageError(
                f"{node.nodeid}: @pytest.mark.vehicle takes options by name, such as vehicle(wind=5); "
                f"got {marker.args!r}"
            )
        options |= marker.kwargs
        parameters |= marker.kwargs.get("parameters") or {}
    return {**options, "parameters": parameters}


def _made(folder: Path) -> bool:
    """Make a folder; False if another process was faster."""
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        return False
    return True


def _folder_for(request: pytest.FixtureRequest) -> Path:
    """A new folder named after the test."""
    logs: Path | None = request.config.getoption("--vehicle-logs")
    if logs is None:
        factory: pytest.TempPathFactory = request.getfixturevalue("tmp_path_factory")
        logs = factory.getbasetemp() / "vehicles"
    name = re.sub(r"\W+", "-", request.node.nodeid)[-100:].strip("-")
    number = 1
    while not _made(folder := logs.absolute() / f"{name}-{number}"):
        number += 1
    return folder


@pytest.fixture
def make_vehicle(request: pytest.FixtureRequest) -> Iterator[Callable[..., RunningSimulator]]:
    """A function that starts a vehicle: `make_vehicle(wind=5, system_id=2)`; all are stopped after the test.

    Options of the test's `vehicle` marker apply to each; those of the call override them.
    """
    from mavlink_sim.testing import vehicle

    marked = _marked_options(request.node)
    flights = request.node.stash.setdefault(_FLIGHTS, _Flights())
    with ExitStack() as running:

        def start(**options: Any) -> RunningSimulator:
            folder = _folder_for(request)
            parameters = {**marked["parameters"], **(options.pop("parameters", None) or {})}
            chosen = {"record": folder, **marked, **options, "parameters": parameters}
            try:
                simulator = running.enter_context(vehicle(**chosen))
            except BaseException:
                shutil.rmtree(folder, ignore_errors=True)
                raise
            flights.kept.append((folder, simulator))
            return simulator

        yield start
    for folder, simulator in flights.kept:
        _write_log(folder, simulator)  # with the end of it


@pytest.fixture
def vehicle(make_vehicle: Callable[..., RunningSimulator]) -> RunningSimulator:
    """A MAVLink vehicle with PX4's behaviour, in its own process, on free ports, ready to be armed.

    `vehicle.mavsdk_url` and `vehicle.pymavlink_device` are the addresses for clients, `vehicle.events` are
    the printed events, `vehicle.wait_for_event("armed")` waits for one.
    """
    return make_vehicle()
