"""Fixtures of the tests in a container that boots systemd: `make test-systemd`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from tests.systemd.container import (
    OLD,
    Container,
    debian,
    install_wheel,
    packages,
    running,
    start_simulator,
)
from tests.test_distribution import build


class Computer:
    """Makes containers with the two environments, in which nothing is installed yet."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._numbers = folder, itertools.count(1)
        self._system = debian()
        self._shared = packages(self._system)
        install_wheel(self._system, build(folder, "build_wheel"), folder / "prepared")

    def booted(self) -> AbstractContextManager[Container]:
        """Boot a new container."""
        lower = (self._folder / "prepared" / "upper", self._system)
        return running(lower, self._folder / str(next(self._numbers)), self._shared)


@pytest.fixture(scope="session")
def computer(tmp_path_factory: pytest.TempPathFactory) -> Computer:
    return Computer(tmp_path_factory.mktemp("computer"))


@pytest.fixture
def empty(computer: Computer) -> Iterator[Container]:
    """A container of its own, in which nothing is installed."""
    with computer.booted() as container:
        yield container


@pytest.fixture(scope="session")
def installed(computer: Computer) -> Iterator[Container]:
    """A container with the service of the old version, set up by `init`, which the tests share."""
    with computer.booted() as container:
        start_simulator(container)
        container.companion("init", "--yes", environment=OLD)
        container.companion("install", environment=OLD)
        yield container
