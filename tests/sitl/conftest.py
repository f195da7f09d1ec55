"""Fixtures for tests against a real or simulated autopilot (`docs/how-to/sitl.md`)."""

from __future__ import annotations

import contextlib
import json
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.vehicle.link_url import parse_link_url
from tests.companion.service_process import running_service
from tests.sitl.sitl_harness import FIGURES, NAMES, PX4, READY_S, AutopilotLink, Flight, bring_down

URL = "COMPANION_SITL_URL"
REPORT = "COMPANION_SITL_REPORT"
HEARTBEAT_S = 60.0


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip without an autopilot; one driver after the other, and last what may not come back."""
    ours = [item for item in items if item.get_closest_marker("sitl")]
    if URL not in os.environ:
        for item in ours:
            item.add_marker(pytest.mark.skip(reason=f"{URL} names no autopilot"))
    ours.sort(key=lambda item: ("reboot" in item.name, "mavsdk" in item.name))
    items[:] = [item for item in items if item not in set(ours)] + ours


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print what was measured, and write it to the file that COMPANION_SITL_REPORT names."""
    if not FIGURES:
        return
    terminalreporter.section("measured")
    for driver, names in FIGURES.items():
        for name, values in names.items():
            terminalreporter.write_line(f"{driver}: {name}: {json.dumps(values)}")
    if path := os.environ.get(REPORT):
        Path(path).write_text(json.dumps(FIGURES, indent=1) + "\n")


@pytest.fixture(scope="session")
def link() -> Iterator[AutopilotLink]:
    """The connected autopilot."""
    opened = AutopilotLink(parse_link_url(os.environ[URL]))
    try:
        opened.until(lambda: opened.autopilot in NAMES, HEARTBEAT_S, f"heartbeat at {os.environ[URL]}")
        opened.read_version()
        yield opened
        if opened.other_senders:
            addresses = sorted(opened.other_senders)
            warnings.warn(f"other programs sent to {os.environ[URL]}, dropped: {addresses}", stacklevel=1)
    finally:
        opened.close()


@pytest.fixture(params=["pymavlink", "mavsdk"])
def driver(request: pytest.FixtureRequest, link: AutopilotLink) -> str:
    """Which library flies it."""
    if request.param == "mavsdk" and link.autopilot != PX4:
        pytest.skip("the mavsdk driver flies PX4 alone; this is ArduPilot")
    return str(request.param)


class Services:
    """One service at a time, kept from test to test as long as it runs and was started as is wanted."""

    def __init__(self, link: AutopilotLink, folder: Path) -> None:
        self._link, self._folder = link, folder
        self._started_as: tuple[str | None, ...] = ()
        self._stack = contextlib.ExitStack()
        self._flight: Flight | None = None

    def flags(self, driver: str | None) -> list[str]:
        """What a service is started with. None: no driver is named."""
        (self._folder / "frame.ppm").write_bytes(b"P6 4 4 255\n" + bytes(48))
        flags = ["--source", "frame.ppm", "--source-loop", "true", "--source-rate-hz", "1"]
        flags += ["--detector-enabled", "false", "--vehicle-system-id", str(self._link.system_id)]
        flags += ["--guidance-min-battery-percent", "0"]  # simulated batteries are not charged between tests
        return flags if driver is None else [*flags, "--driver", driver]

    def flight(self, driver: str | None, *more: str) -> Flight:
        """With this driver, and these flags besides."""
        flight, wanted = self._flight, (driver, *more)
        if flight is None or self._started_as != wanted or flight.service.process.poll() is not None:
            self.close()
            service = running_service(self._link.service_port, [*self.flags(driver), *more], cwd=self._folder)
            running = self._stack.enter_context(service)
            session = self._stack.enter_context(running.client())
            self._flight = flight = Flight(self._link, running, session, driver or "no driver named")
            self._started_as = wanted
        return flight

    def close(self) -> None:
        """End what runs."""
        self._flight = None
        self._stack.close()


@pytest.fixture(scope="session")
def services(link: AutopilotLink, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Services]:
    """The running service."""
    opened = Services(link, tmp_path_factory.mktemp("sitl"))
    yield opened
    opened.close()


@pytest.fixture
def flight(link: AutopilotLink, driver: str, services: Services) -> Iterator[Flight]:
    """A service that is ready, before a vehicle that is on the ground and ready to be armed."""
    if not link.connected:
        pytest.skip("the autopilot is gone")
    bring_down(link)
    ready = services.flight(driver)
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    yield ready
    bring_down(link)


@pytest.fixture
def parameters(flight: Flight) -> Iterator[dict[str, float]]:
    """What a test sets is written here, and taken back."""
    before: dict[str, float] = {}
    yield before
    flight.link.cut = False
    for name, value in before.items():
        flight.link.set_parameter(name, value)
