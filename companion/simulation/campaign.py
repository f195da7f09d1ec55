"""One function over many seeds: in this process, in several, or on a Ray cluster (extra `learn`).

The results come in the seeds' order and depend on the seeds alone. A seed whose worker dies is run again.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stdout
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Any, TypeVar

from vision.extras import missing_module

Result = TypeVar("Result")

# Of workers that died, for one seed on a cluster, for all seeds in processes of this machine.
MAX_RETRIES = 3
# Ray itself tries an address where no cluster answers for many minutes.
ANSWER_S = 20.0
# Of a seed: the largest that numpy, torch and a training's steps added to it allow, rounded.
MAX_SEED = 2**31
# Sent to the workers, so that a cluster runs the code of this process.
_PACKAGES = ("benchmarks", "companion", "mavlink_sim", "vision")


class ClusterError(RuntimeError):
    """The Ray cluster cannot be used. The message is one line."""


class SeedError(RuntimeError):
    """The function failed for a seed, or every worker that ran it died. The message names the seed."""


def map_seeds(
    function: Callable[[int], Result], seeds: Sequence[int], *, processes: int = 1, ray: str | None = None
) -> Iterator[Result]:
    """The function's result for each seed, in the seeds' order.

    Args:
        function: to be pickled; its result must depend on the seed alone.
        processes: at once; 1 runs in this one. A cluster decides itself.
        ray: HOST:PORT of a Ray cluster of which this machine is a node.

    Raises:
        ClusterError: Ray is not installed, or no cluster answers there.
        SeedError: the function raised, or `MAX_RETRIES` more workers died.
    """
    if ray is not None:
        return _on_cluster(function, seeds, ray)
    call = partial(_named, function)
    if processes <= 1 or len(seeds) <= 1:
        return map(call, seeds)
    return _in_processes(call, seeds, processes)


def seeds_of(text: str) -> list[int]:
    """`1..50` or `1,5,9..12` as numbers. Raises ValueError for what is none, and for a seed given twice."""
    return numbers_of(text, "seeds", MAX_SEED)


def numbers_of(text: str, name: str, largest: int) -> list[int]:
    """The same for other numbers of this name, 0 to `largest`."""
    numbers: list[int] = []
    for part in text.split(","):
        first, dots, last = part.strip().partition("..")
        try:
            low = int(first)
            high = int(last) if dots else low
        except ValueError:
            raise ValueError(f"{name} {text!r}: expected numbers and ranges such as 1..50 or 3,7") from None
        if not 0 <= low <= high <= largest:
            raise ValueError(f"{name} {text!r}: {part.strip()} is no range of {name} from 0 to {largest}")
        numbers.extend(range(low, high + 1))
    twice = next((number for number, count in Counter(numbers).items() if count > 1), None)
    if twice is not None:
        raise ValueError(f"{name} {text!r}: {twice} is given twice")
    return numbers


def _named(function: Callable[[int], Result], seed: int) -> Result:
    try:
        return function(seed)
    except Exception as error:
        raise SeedError(f"seed {seed}: {type(error).__name__}: {error}") from error


def _one_thread() -> None:
    # A thread pool of a network in every process would have them wait for each other.
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def _in_processes(call: Callable[[int], Result], seeds: Sequence[int], processes: int) -> Iterator[Result]:
    done = 0
    for _ in range(1 + MAX_RETRIES):
        left = seeds[done:]
        try:
            with ProcessPoolExecutor(
                min(processes, len(left)), get_context("spawn"), initializer=_one_thread
            ) as pool:
                try:
                    for result in pool.map(call, left):
                        done += 1
                        yield result
                except (KeyboardInterrupt, GeneratorExit):
                    pool.shutdown(wait=False, cancel_futures=True)
                    for worker in active_children():  # else their seeds would be waited for
                        worker.terminate()
                    raise
            return
        except BrokenProcessPool:
            continue
    raise SeedError(f"seed {seeds[done]}: no result, {1 + MAX_RETRIES} times a worker process died")


def _on_cluster(function: Callable[[int], Result], seeds: Sequence[int], address: str) -> Iterator[Result]:
    ray = _connected(address)
    try:
        task = ray.remote(_named).options(num_cpus=1, max_retries=MAX_RETRIES)
        pending = [task.remote(function, seed) for seed in seeds]
        for seed, result in zip(seeds, pending, strict=True):
            try:
                with redirect_stdout(sys.stderr):  # Ray prints of workers that died
                    value = ray.get(result)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error
            except ray.exceptions.RayError as error:
                raise SeedError(f"seed {seed}: no result from {address}: {_one_line(error)}") from error
            yield value
    finally:
        with redirect_stdout(sys.stderr):  # the rest of these lines
            ray.shutdown()


def _connected(address: str) -> Any:
    """The module `ray`, connected. Raises ClusterError."""
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ClusterError(f"--ray: {missing_module(error) or error}") from error
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in host:
        raise ClusterError(f"--ray {address}: expected HOST:PORT, as `ray start --head --port PORT` opens it")
    try:
        until_s = time.monotonic() + ANSWER_S
        _connect(host, int(port), until_s)
        # In another process, because no call of Ray's takes a time limit for this.
        command = (sys.executable, "-m", "ray.scripts.scripts", "status", "--address", address)
        left_s = until_s - time.monotonic()
        asked = subprocess.run(command, capture_output=True, text=True, timeout=left_s)
    except (OSError, OverflowError, subprocess.TimeoutExpired) as error:
        why = f"nothing in {ANSWER_S:g} s" if isinstance(error, subprocess.TimeoutExpired) else error
        raise ClusterError(
            f"--ray {address}: no Ray cluster answers ({why}): `ray start` starts one"
        ) from error
    if asked.returncode != 0:
        message = asked.stderr.rpartition("Error: ")[2]
        raise ClusterError(f"--ray {address}: {_one_line(message)}")
    root = Path(__file__).parents[2]
    modules = [str(root / name) for name in _PACKAGES if (root / name).is_dir()]
    try:
        ray.init(address, runtime_env={"py_modules": modules}, log_to_driver=False, logging_level="ERROR")
    except (RuntimeError, OSError, ValueError) as error:
        raise ClusterError(f"--ray {address}: {_one_line(error)}") from error
    if ray.cluster_resources().get("CPU", 0.0) < 1.0:
        ray.shutdown()
        raise ClusterError(f"--ray {address}: the cluster has no processors: `ray start --num-cpus`")
    return ray


def _connect(host: str, port: int, until_s: float) -> None:
    """Connect to the first address of the host that answers until then. Raises OSError."""
    refused: OSError = TimeoutError()
    for family, kind, protocol, _, place in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
        with socket.socket(family, kind, protocol) as connection:
            try:
                connection.settimeout(max(until_s - time.monotonic(), 0.01))
                connection.connect(place)
                return
            except OSError as error:
                refused = error
    raise refused


def _one_line(text: object) -> str:
    return " ".join(str(text).split())[:300]
