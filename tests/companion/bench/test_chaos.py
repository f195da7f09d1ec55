"""The soak: its faults, its comparison, its clock; and a short one."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path

import pytest

from companion.bench.chaos import FAULTS, ChaosResult, differences, faults_in_order, run_chaos
from companion.bench.process_figures import Figures, figures_of, total
from companion.bench.stepped_clock import set_step
from mavlink_sim.faults.grammar import parse_fault
from mavlink_sim.faults.kinds import KINDS

SOUND = Figures(300.0, 40, 20)


def test_every_fault_comes_before_one_comes_twice() -> None:
    first, second = (list(islice(faults_in_order(7), 2 * len(FAULTS))) for _ in range(2))
    assert first == second
    assert set(first[: len(FAULTS)]) == set(first[len(FAULTS) :]) == set(FAULTS)
    assert first[: len(FAULTS)] != first[len(FAULTS) :]


def test_the_simulator_knows_the_faults_and_few_are_left_out() -> None:
    names = {parse_fault(fault.what, KINDS).kind.name for fault in FAULTS if fault.target == "vehicle"}
    assert set(KINDS) - names == {"motor_failure", "reboot"}


@pytest.mark.parametrize(
    ("after", "count"),
    [
        (SOUND, 0),
        (Figures(304.9, 40, 20), 0),
        (Figures(250.0, 40, 20), 0),
        (Figures(305.1, 40, 20), 1),
        (Figures(300.0, 41, 20), 1),
        (Figures(300.0, 40, 19), 1),
    ],
)
def test_growth_beyond_the_limits_is_a_failure(after: Figures, count: int) -> None:
    assert len(differences({"service": SOUND}, {"service": after})) == count
    result = ChaosResult(1.0, 1, 3, 3, before={"service": SOUND}, after={"service": after})
    assert result.success is (count == 0)
    assert json.loads(json.dumps(result.as_dict()))["success"] is result.success


def test_a_flight_that_has_not_landed_is_a_failure() -> None:
    figures = {"service": SOUND}
    assert not ChaosResult(1.0, 1, 3, 2, before=figures, after=figures).success
    assert not ChaosResult(1.0, 1, 0, 0, before=figures, after=figures).success
    assert not ChaosResult(1.0, 1, 3, 3, before=figures, after=figures, problems=("one",)).success
    assert not ChaosResult(1.0, 1, 3, 3).success


def test_figures_are_those_of_a_process_and_its_children() -> None:
    child = (
        "import subprocess, sys; p = subprocess.Popen(['sleep', '60']); print(p.pid, flush=True); p.wait()"
    )
    with subprocess.Popen([sys.executable, "-c", child], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        grandchild = int(parent.stdout.readline())
        found = figures_of(parent.pid)
        subprocess.run(["kill", str(grandchild)], check=True)
    assert set(found) == {"service", "sleep"}
    assert total(found.values()).threads == 2
    assert found["service"].rss_mb > found["sleep"].rss_mb > 0.0


def test_the_clock_of_a_process_follows_the_file(tmp_path: Path) -> None:
    offset = tmp_path / "clock"
    offset.write_text("3600")
    code = (
        "import sys, time; from pathlib import Path; from companion.bench.stepped_clock import step_clock\n"
        "path = Path(sys.argv[1]); step_clock(path); print(time.time(), time.time_ns())\n"
        "path.write_text('-3600.0'); print(time.time(), time.time_ns())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(offset)], capture_output=True, text=True, check=True
    )
    words = [float(word) for word in done.stdout.split()]
    now_s = time.time()
    assert words[0] == pytest.approx(now_s + 3600.0, abs=60.0)
    assert words[1] / 1e9 == pytest.approx(now_s + 3600.0, abs=60.0)
    assert words[2] == pytest.approx(now_s - 3600.0, abs=60.0)
    assert words[3] / 1e9 == pytest.approx(now_s - 3600.0, abs=60.0)


def test_a_process_never_reads_half_a_step(tmp_path: Path) -> None:
    set_step(path := tmp_path / "clock", 0.0)
    with path.open() as read_meanwhile:
        set_step(path, 3600.0)
        assert float(read_meanwhile.read()) == 0.0
    assert float(path.read_text()) == 3600.0
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(600)
def test_a_short_soak_lands_every_flight() -> None:
    lines: list[str] = []
    result = run_chaos(1.0, seed=3, period_s=10.0, say=lines.append)
    assert result.problems == (), lines
    assert result.flights == result.landed >= 3, lines
    assert sum(result.faults.values()) >= 5
