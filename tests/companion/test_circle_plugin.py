"""The example plug-in, installed and flown in lockstep; `test_examples` flies it by the service."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.guidance.command import COMMANDS

EXAMPLE = Path(__file__).parents[2] / "examples" / "circle"


def installed_package(example: Path, folder: Path) -> Path:
    """A folder with the package, as pip installs it."""
    pytest.importorskip("setuptools")
    source, target = folder / "source", folder / "site"
    source.mkdir()
    for file in example.iterdir():
        if file.is_file():
            (source / file.name).write_bytes(file.read_bytes())
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--no-index", "--target", str(target), str(source)], check=True, timeout=100)
    return target


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return installed_package(EXAMPLE, tmp_path_factory.mktemp("circle"))


def test_example_has_at_most_forty_lines() -> None:
    assert len((EXAMPLE / "companion_circle.py").read_text().splitlines()) <= 40


def test_plugin_flies_its_circle(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(installed)
    before = dict(COMMANDS)
    try:
        settings = plain_settings({"plugins.modules": "circle"})
        flight = LockstepFlight.airborne(seed=3, settings=settings)
        flight.command("circle radius=6 speed=1.5")
        flight.run(10.0)
        positions = []
        for _ in range(17):  # two thirds of a lap: 2 pi 6 m / 1.5 m/s
            flight.run(1.0)
            positions.append(flight.vehicle.truth.position_ned_m)
    finally:
        COMMANDS.clear()
        COMMANDS.update(before)
        sys.modules.pop("companion_circle", None)
    # The circle that fits best: x^2 + y^2 = 2 a x + 2 b y + c (Kasa 1976).
    points = np.array([position[:2] for position in positions])
    terms = np.column_stack([2 * points, np.ones(len(points))])
    (north, east, rest), *_ = np.linalg.lstsq(terms, (points**2).sum(axis=1), rcond=None)
    radius = math.sqrt(rest + north**2 + east**2)
    assert abs(radius - 6.0) < 1.0
    assert np.ptp(np.hypot(*(points - (north, east)).T)) < 1.2
