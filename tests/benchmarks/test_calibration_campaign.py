"""Lenses and mounts calibrated from rendered images, within the errors of docs/measurements.md."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from benchmarks.calibration import extrinsics_error, lens_error, main, mount_error, random_lens
from mavlink_sim.datasets.board_views import LENSES

SEEDS = range(1, 51)


def check_lens(seed: int, views: int = 40) -> None:
    error = lens_error(seed, views)
    assert error.focal_percent < 0.3
    assert error.centre_px < 1.0
    assert error.rms_px < 0.2


def test_seed_gives_its_lens() -> None:
    assert random_lens(3) == random_lens(3)
    assert {random_lens(seed)[0] for seed in range(4)} == set(LENSES)


@pytest.mark.slow
def test_fisheye_is_calibrated_from_rendered_views() -> None:
    check_lens(3, 7)


def test_mounts_are_measured_by_two_processes_in_order_of_seeds(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--mount", "--seeds", "2,1", "--processes", "2", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["seed"] for row in rows] == [2, 1]
    error = mount_error(1)
    assert rows[1] == asdict(error) != {**rows[0], "seed": 1}
    assert error.angle_deg < 0.3
    assert error.views == 10
    with pytest.raises(SystemExit) as refused:
        main(["--seeds", "1-2"])
    assert refused.value.code == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 9))
def test_extrinsics_of_every_seed(seed: int) -> None:
    error = extrinsics_error(seed)
    assert error.position_mm < 2.0
    assert error.rotation_deg < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_lens_of_every_seed(seed: int) -> None:
    check_lens(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_mount_of_every_seed(seed: int) -> None:
    assert mount_error(seed).angle_deg < 0.3
