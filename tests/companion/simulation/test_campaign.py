"""The same seeds give the same results in one process, in two, and on a Ray cluster."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks import flights, geolocation
from benchmarks.rendered import camera_settings
from companion.bench import demo_flight
from companion.cli import app
from companion.settings import Settings
from companion.simulation.campaign import MAX_RETRIES, ClusterError, SeedError, map_seeds, seeds_of
from tests.companion.seed_functions import endless, killed, killed_once, squared

SEEDS = range(6)
SQUARES = [0, 1, 4, 9, 16, 25]


def test_seeds_are_numbers_and_ranges() -> None:
    assert seeds_of("1..3, 7,9..9") == [1, 2, 3, 7, 9]
    for wrong in ("", "a", "3..1", "-1", "1..b", "1,1", "3,1..4", "99999999999", "0..99999999999"):
        with pytest.raises(ValueError, match="seeds"):
            seeds_of(wrong)


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_order_and_an_error_names_its_seed(processes: int) -> None:
    results = map_seeds(squared, [3, 1, 2, 7, 4], processes=processes)
    assert [next(results), next(results), next(results)] == [9, 1, 4]
    with pytest.raises(SeedError, match="seed 7: ValueError: refused 7"):
        next(results)


def test_a_killed_process_loses_no_seed(tmp_path: Path) -> None:
    assert list(map_seeds(partial(killed_once, tmp_path), SEEDS, processes=2)) == SQUARES
    assert (tmp_path / "tried").exists()


def test_a_seed_that_kills_every_process_is_named() -> None:
    results = map_seeds(killed, [1, 3], processes=2)
    with pytest.raises(SeedError, match=f"seed [13]: .* {1 + MAX_RETRIES} times"):
        list(results)


def test_an_interrupted_campaign_does_not_wait_for_its_workers() -> None:
    results = map_seeds(endless, [1, 2, 3, 4], processes=2)
    assert next(results) == 1
    assert isinstance(results, Generator)
    results.close()  # as a KeyboardInterrupt in the loop


def test_detectors_of_campaigns_take_no_measured_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    """What `auto` selects is measured, and differs between machines."""
    taken: list[Settings] = [camera_settings(geolocation.CAMERA, geolocation.MOUNT)]

    def camera(settings: Settings, *_: object, **__: object) -> None:
        taken.append(settings)
        raise InterruptedError

    monkeypatch.setattr(demo_flight, "RenderedCamera", camera)
    with pytest.raises(InterruptedError):
        demo_flight.fly_demo(3)
    assert [(each.detector.runtime, each.detector.precision) for each in taken] == [(None, "float32")] * 2
    assert taken[1].detector.threads == 1


def test_missing_ray_is_one_line_that_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    for command in (
        ["demo", "--seeds", "1..2"],
        ["learn", "train", "--policy", "companion/CartPole-v0", "--seeds", "1..2"],
    ):
        result = CliRunner().invoke(app, [*command, "--ray", "127.0.0.1:6379"])
        assert result.exit_code == 2
        assert "mavlink-companion[learn]" in result.stderr
        assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize("command", [["demo"], ["learn", "train", "--policy", "companion/CartPole-v0"]])
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("--ray 127.0.0.1:6379", "--seeds"),
        ("--processes 2", "--seeds"),
        ("--seed 9 --seeds 1,2", "--seed and --seeds"),
        ("--seeds 1,2 --processes 2 --ray 127.0.0.1:6379", "--processes and --ray"),
        ("--seeds 1,1", "1 is given twice"),
        ("--seeds 99999999999", "99999999999"),
    ],
)
def test_contradicting_options_are_refused(command: list[str], options: str, named: str) -> None:
    result = CliRunner().invoke(app, [*command, *options.split()])
    assert result.exit_code == 2
    assert named in result.stderr
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("main", "options"),
    [
        (geolocation.main, "--seeds a"),
        (geolocation.main, "--seeds 2,2"),
        (geolocation.main, "--processes 0"),
        (flights.main, "approach --processes 2 --ray 127.0.0.1:6379"),
    ],
)
def test_wrong_options_of_benchmarks_are_exit_code_2(
    main: Callable[[list[str]], int], options: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        main(options.split())
    assert refused.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--synthetic", "--json"])
def test_options_of_seeds_start_no_demonstration(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("companion.simulation.demo.run_demo", None)
    result = CliRunner().invoke(app, ["demo", option])
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert option in line
    assert "--seeds" in line
    assert not list(tmp_path.iterdir())


def test_failed_seed_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(flights, "flight_named", lambda _: squared)
    assert flights.main(["approach", "--runs", "1", "--seed", "7"]) == 2
    monkeypatch.setattr(geolocation, "flight_of", lambda seed, **_: squared(seed))
    assert geolocation.main(["--seeds", "7"]) == 2
    assert capsys.readouterr().err.splitlines() == ["seed 7: ValueError: refused 7"] * 2
    monkeypatch.setattr(demo_flight, "fly_demo", lambda seed, **_: squared(seed))
    result = CliRunner().invoke(app, ["demo", "--seeds", "7"])
    assert result.exit_code == 2
    assert result.stderr.splitlines() == ["companion: seed 7: ValueError: refused 7"]


def test_address_without_a_cluster_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ray", reason="ray is of the optional extra learn")
    with socket.socket() as bound:  # not listening: a connection is refused
        bound.bind(("127.0.0.1", 0))
        unused = f"127.0.0.1:{bound.getsockname()[1]}"
        for address in (unused, "ray://127.0.0.1:10001", "127.0.0.1", "127.0.0.1:x", "127.0.0.1:99999"):
            with pytest.raises(ClusterError) as refused:
                list(map_seeds(squared, SEEDS, ray=address))
            assert address in str(refused.value)
            assert len(str(refused.value).splitlines()) == 1
        assert flights.main(["approach", "--runs", "1", "--ray", unused]) == 2
        assert geolocation.main(["--seeds", "1", "--ray", unused]) == 2
    assert unused in capsys.readouterr().err


@pytest.fixture(scope="module", autouse=True)
def token() -> Iterator[None]:
    """A token, because Ray listens on every address; set before any test imports Ray, which reads it then."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "token")
        patch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
        yield


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a Ray cluster of two processors on this machine."""
    pytest.importorskip("ray", reason="ray is of the optional extra learn")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory(prefix="ray") as folder:
        command = f"start --head --block --port {port} --num-cpus 2 --temp-dir {folder} --disable-usage-stats"
        started = subprocess.Popen(
            [sys.executable, "-m", "ray.scripts.scripts", *command.split(), "--include-dashboard=false"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            process_group=0,
        )
        assert started.stdout is not None
        try:
            assert any("runtime started" in line for line in started.stdout)
            yield f"127.0.0.1:{port}"
        finally:
            os.killpg(started.pid, signal.SIGKILL)
            started.wait()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_cluster_gives_the_flights_of_one_and_of_two_processes(cluster: str) -> None:
    seeds = range(40, 43)
    one = list(flights.fly("approach", seeds))
    assert [flight.seed for flight in one] == list(seeds)
    assert list(flights.fly("approach", seeds, 2)) == one
    assert list(flights.fly("approach", seeds, ray=cluster)) == one


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_cluster_trains_the_policies_of_one_and_of_two_processes(cluster: str, tmp_path: Path) -> None:
    trainer = pytest.importorskip(
        "companion.learning.train_policy", reason="companion.learning.train_policy needs the extra learn"
    )
    trained = {}
    for name, options in (("one", {}), ("two", {"processes": 2}), ("ray", {"ray": cluster})):
        output = tmp_path / name / "policy.onnx"
        made = list(trainer.train_policies("companion/CartPole-v0", "ppo", [1, 2], 1, output, **options))
        trained[name] = [(file.name, figures, file.read_bytes()) for file, figures in made]
    assert trained["one"] == trained["two"] == trained["ray"]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_killed_worker_of_a_cluster_loses_no_seed(cluster: str, tmp_path: Path) -> None:
    assert list(map_seeds(partial(killed_once, tmp_path), SEEDS, ray=cluster)) == SQUARES
    assert (tmp_path / "tried").exists()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_an_error_on_a_cluster_names_its_seed(cluster: str, capsys: pytest.CaptureFixture[str]) -> None:
    results = map_seeds(squared, [2, 7, 4], ray=cluster)
    assert next(results) == 4
    with pytest.raises(SeedError, match="seed 7: ValueError: refused 7"):
        next(results)
    with pytest.raises(SeedError, match="seed 3: no result"):
        list(map_seeds(killed, [3], ray=cluster))
    assert not capsys.readouterr().out
