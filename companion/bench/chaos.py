"""The soak: the demonstration repeats while something goes wrong every minute, and every flight must land.

Simulated vehicle, camera and service are processes of their own, as in use; the link is signed. Faults come
from the simulator's grammar (docs/faults.md), or are done to the service's processes, its clock and this
computer's memory. Left out are a failed rotor and a restart of the autopilot in the air: what falls does not
land.
"""

from __future__ import annotations

import asyncio
import json
import os
import queue
import random
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import zenoh

from companion.bench.process_figures import Figures, settled_figures, total
from companion.bench.stepped_clock import set_step
from companion.bus.client import client_settings, listen, open_client
from companion.bus.topics import command_key
from companion.host.peer_data import copy_payload
from companion.settings import Settings
from companion.settings.reading import to_toml
from companion.simulation.session import (
    DEMO_NOISE,
    MISSION,
    SimOptions,
    SimProcess,
    SimSessionError,
    session_settings,
    simulator,
    with_lens,
)
from mavlink_sim.testing import free_port

RSS_LIMIT_MB = 5.0
_STOPPED_S, _CLOCK_S, _MEMORY_S = 3.0, 20.0, 15.0
_MEMORY_SHARE, _MEMORY_MOST_MB = 0.25, 1000
_HOUR_S = 3600.0
_CAMERA_RATE_HZ = 10.0
_READY_S, _MISSION_S, _LANDING_S = 120.0, 240.0, 120.0
_POLL_S, _AGAIN_S, _ON_GROUND_S, _SETTLED_S = 0.2, 5.0, 3.0, 8.0
_WARM_UP_FLIGHTS = 2
_LARGEST_BODY = 1_000_000
_TAIL_BYTES = 65536  # more than two lines of the truth, which have every object
_ALLOCATES = (
    "import sys, time; held = bytearray(int(sys.argv[1])); held[::4096] = b'1' * len(held[::4096]); "
    "time.sleep(float(sys.argv[2]))"
)

Say = Callable[[str], None]
Target = Literal["vehicle", "worker", "service", "clock", "memory"]


@dataclass(frozen=True, slots=True)
class ChaosFault:
    """One fault.

    Attributes:
        what: a line of the simulator's grammar; else what is done to `target`, a signal or a step in seconds.
        lasts_s: seconds until it is over, at most.
    """

    what: str
    target: Target = "vehicle"
    lasts_s: float = 0.0

    @property
    def name(self) -> str:
        """For people, and of the count."""
        return self.what.partition(" for=")[0] if self.target == "vehicle" else f"{self.target} {self.what}"


def _vehicle(what: str, lasts_s: float) -> ChaosFault:
    return ChaosFault(f"{what} for={lasts_s:g}", lasts_s=lasts_s)


FAULTS: tuple[ChaosFault, ...] = (
    *(_vehicle(what, 15.0) for what in ("link_delay 0.2", "link_jitter 0.1", "packet_loss 0.2")),
    *(_vehicle(what, 15.0) for what in ("duplicate 0.2", "reorder 0.2", "corrupt 0.05", "rate_limit 20000")),
    *(_vehicle(what, 15.0) for what in ("lost_ack 1", "gps_drift 0.3", "ekf_reset 1 -1 0", "wind 3")),
    *(_vehicle(what, 10.0) for what in ("time_jump 100", "second_autopilot 2", "gps_loss", "battery low")),
    _vehicle("link_loss", 4.0),
    _vehicle("heartbeat_only", 5.0),
    _vehicle("stall", 2.0),
    _vehicle("height_drift", 10.0),
    _vehicle("camera_freeze", 6.0),
    _vehicle("gust 5", 4.0),
    _vehicle("pilot_takeover", 8.0),
    ChaosFault("refuse_mode count=1 for=15", lasts_s=15.0),
    ChaosFault("SIGSTOP", "worker", _STOPPED_S),
    ChaosFault("SIGKILL", "worker", 15.0),
    ChaosFault("SIGSTOP", "service", _STOPPED_S),
    ChaosFault("+1 h", "clock", _CLOCK_S),
    ChaosFault("-1 h", "clock", _CLOCK_S),
    ChaosFault("pressure", "memory", _MEMORY_S),
)


def faults_in_order(seed: int) -> Iterator[ChaosFault]:
    """Yield all faults in a random order, again and again: each comes before one comes twice."""
    order = random.Random(seed)
    while True:
        yield from order.sample(FAULTS, len(FAULTS))


@dataclass(frozen=True, slots=True)
class ChaosResult:
    """The result of a soak.

    Attributes:
        flights: in the air, of which so many `landed`, disarmed on the ground by the simulator's truth.
        missions: flown to their end. faults: name → how often. problems: what must not happen, one line each.
        before, after: figures after the flights of the warm-up and at the end, on the ground, by process. The
            worker is as old at both: it was ended by SIGKILL before the last flight.
        load: of the computer during it, 1 minute's average.
    """

    minutes: float
    seed: int
    flights: int = 0
    landed: int = 0
    missions: int = 0
    faults: dict[str, int] = field(default_factory=dict)
    before: dict[str, Figures] = field(default_factory=dict)
    after: dict[str, Figures] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    load: tuple[float, float] = (0.0, 0.0)

    @property
    def success(self) -> bool:
        """Whether nothing happened that must not."""
        return not (self.problems or differences(self.before, self.after)) and self.flights == self.landed > 0

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        sums = {"before_total": self.before, "after_total": self.after}
        return {
            **asdict(self),
            **{name: asdict(total(figures.values())) for name, figures in sums.items()},
            "differences": differences(self.before, self.after),
            "success": self.success,
        }


def differences(before: dict[str, Figures], after: dict[str, Figures]) -> list[str]:
    """Return what has grown beyond its limit: memory by 5 MB, descriptors and threads at all."""
    if not before or not after:
        return ["not measured: the soak was too short for the flights of the warm-up and one more"]
    one, other = total(before.values()), total(after.values())
    found = []
    if other.rss_mb > one.rss_mb + RSS_LIMIT_MB:
        found.append(f"memory: {one.rss_mb:.1f} MB before, {other.rss_mb:.1f} MB after")
    for name in ("descriptors", "threads"):
        if getattr(one, name) != getattr(other, name):
            found.append(f"{name}: {getattr(one, name)} before, {getattr(other, name)} after")
    return found


def lines_of(result: ChaosResult) -> Iterator[str]:
    """Yield the result as lines for people."""
    yield f"flights {result.flights}, landed {result.landed}, whole missions {result.missions}"
    yield f"faults {sum(result.faults.values())}: " + ", ".join(
        f"{name} {count}" for name, count in sorted(result.faults.items())
    )
    for name in sorted({*result.before, *result.after}):
        one, other = result.before.get(name, Figures()), result.after.get(name, Figures())
        yield _compared(name, one, other)
    yield _compared("all", total(result.before.values()), total(result.after.values()))
    yield f"load {result.load[0]:.1f} to {result.load[1]:.1f}"
    yield from (f"fault: {line}" for line in (*result.problems, *differences(result.before, result.after)))


def _compared(name: str, one: Figures, other: Figures) -> str:
    return (
        f"{name:<42} {one.rss_mb:7.1f} → {other.rss_mb:7.1f} MB, descriptors {one.descriptors} → "
        f"{other.descriptors}, threads {one.threads} → {other.threads}"
    )


def run_chaos(
    minutes: float, *, seed: int = 1, period_s: float = 60.0, say: Say, log_path: Path | None = None
) -> ChaosResult:
    """Fly the demonstration again and again for a time, with a fault every `period_s` seconds.

    Args:
        log_path: for what the service prints; None: it is not kept.

    Raises:
        SimSessionError: the simulator or the service did not start, or has ended.
    """
    return asyncio.run(_run(minutes, seed, period_s, say, log_path))


async def _run(minutes: float, seed: int, period_s: float, say: Say, log_path: Path | None) -> ChaosResult:
    with tempfile.TemporaryDirectory(prefix="companion-chaos-") as name:
        folder = Path(name)
        camera, control = f"companion-chaos-{os.getpid()}", f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        key, clock, truth = folder / "signing.key", folder / "clock", folder / "truth.jsonl"
        key.touch(0o600)
        key.write_bytes(secrets.token_bytes(32))
        set_step(clock, 0.0)
        options = SimOptions(
            camera,
            seed,
            camera_rate_hz=_CAMERA_RATE_HZ,
            truth_path=truth,
            noise=DEMO_NOISE,
            control=control,
            signing_key=key,
        )
        async with simulator(options) as vehicle:
            await vehicle.until_ready()
            settings = with_lens(session_settings(vehicle.port, camera))
            signed = settings.vehicle.model_copy(update={"signing_key_file": str(key)})
            settings = settings.model_copy(update={"vehicle": signed})
            (folder / "companion.toml").write_text(to_toml(settings))
            with (log_path or folder / "service.log").open("wb") as log:
                service = await asyncio.create_subprocess_exec(
                    *(sys.executable, "-m", "companion.bench.stepped_clock", str(clock), "run"),
                    *("--config", str(folder / "companion.toml")),
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                    env={**os.environ, "XDG_STATE_HOME": str(folder / "state"), "STATE_DIRECTORY": ""},
                )
            soak = _Soak(settings, service, vehicle, control, clock, truth, say)
            try:
                return await asyncio.to_thread(soak.run, minutes, seed, period_s)
            finally:
                await soak.end()


class _Soak:
    """One soak: flights and faults, each step of the loop in the caller's thread."""

    def __init__(
        self,
        settings: Settings,
        service: asyncio.subprocess.Process,
        vehicle: SimProcess,
        control: str,
        clock: Path,
        truth: Path,
        say: Say,
    ) -> None:
        self._settings, self._service, self._vehicle = settings, service, vehicle
        self._control, self._clock, self._truth, self._say = control, clock, truth, say
        self._worker_pid: int | None = None
        self._ready = False
        self._undo: list[tuple[float, Callable[[], object]]] = []
        self._over_s = 0.0  # when the last fault is over
        self._faults: Counter[str] = Counter()
        self._problems: list[str] = []
        self._last_fault = "none"
        self._flights = self._landed = self._missions = 0
        self._loads: list[float] = []

    def run(self, minutes: float, seed: int, period_s: float) -> ChaosResult:
        """Fly until the time is up and the last flight has landed."""
        before: dict[str, Figures] = {}
        after: dict[str, Figures] = {}
        with (
            open_client(client_settings(self._settings.zenoh), timeout_s=_READY_S) as session,
            self._faults_session() as faults,
        ):
            listen(session, "status", self._on_status)
            self._until(lambda: self._ready, _READY_S, "the service was not ready")
            for number in range(_WARM_UP_FLIGHTS):
                if number == _WARM_UP_FLIGHTS - 1:
                    self._renew_worker()
                self._fly(session, lambda: None)
            before = self._measured()
            order, until_s = faults_in_order(seed), time.monotonic() + minutes * 60.0
            next_s = time.monotonic() + period_s / 2.0

            def disturb() -> None:
                nonlocal next_s
                if next_s <= time.monotonic() < until_s:
                    next_s += period_s
                    self._begin(next(order), faults)

            while time.monotonic() < until_s and not self._problems:
                self._fly(session, disturb)
            self._until_over()
            self._renew_worker()
            self._fly(session, lambda: None)
            after = self._measured()
        return ChaosResult(
            minutes,
            seed,
            self._flights,
            self._landed,
            self._missions,
            dict(self._faults),
            before,
            after,
            tuple(self._problems),
            (min(self._loads, default=0.0), max(self._loads, default=0.0)),
        )

    # --- flights -------------------------------------------------------------------------------------

    def _fly(self, session: zenoh.Session, disturb: Callable[[], None]) -> None:
        """Fly the demonstration once; what ends it early must land all the same."""
        answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        began_s = sent_s = time.monotonic()
        self._send(session, f"mission {MISSION}", answers)
        flown, answered_s = False, None
        while True:
            disturb()
            self._step()
            row, now_s = self._newest(), time.monotonic()
            flown = flown or not row["landed"]
            while not answers.empty():
                answer = answers.get()
                if answered_s is None:
                    answered_s = now_s
                    self._missions += bool(answer.get("success"))
                    if not answer.get("success"):
                        self._say(f"mission: {answer.get('reason')}")
            on_ground = row["landed"] and not row["armed"]
            if answered_s is not None and on_ground:
                break
            if answered_s is None and now_s - began_s > _MISSION_S:
                self._problems.append(f"flight {self._flights + 1}: no answer within {_MISSION_S:g} s")
                answered_s = now_s
            if answered_s is not None and now_s - sent_s > _AGAIN_S:
                sent_s = now_s
                self._send(session, "land", answers)
            if answered_s is not None and now_s - answered_s > _LANDING_S:
                self._problems.append(
                    f"flight {self._flights + 1}: not landed within {_LANDING_S:g} s, mode {row['mode']}, "
                    f"last fault {self._last_fault}"
                )
                break
        if flown:
            self._flights += 1
            self._landed += bool(on_ground)
            self._say(f"flight {self._flights}: {'landed' if on_ground else 'not landed'}")
        # The service learns of the landing later than the simulator's truth.
        time.sleep(_ON_GROUND_S)

    def _send(self, session: zenoh.Session, text: str, answers: queue.SimpleQueue[dict[str, Any]]) -> None:
        def keep(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                answers.put(_body(reply.ok))
            else:
                answers.put({"success": False, "reason": "no answer"})

        session.get(
            command_key(self._settings.vehicle.name),
            keep,
            payload=text,
            attachment=str(session.zid()),
            timeout=_MISSION_S,
        )

    def _newest(self) -> dict[str, Any]:
        """The newest line of the simulator's truth."""
        with self._truth.open("rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - _TAIL_BYTES, 0))
            lines = file.read().splitlines()
        for line in reversed(lines):
            with suppress(ValueError):
                row: dict[str, Any] = json.loads(line)
                return row
        raise SimSessionError("the simulator has not written its truth")

    def _on_status(self, _key: str, text: str) -> None:
        body = json.loads(text)
        self._worker_pid = body["perception"]["pid"]
        self._ready = bool(body["healthy"])

    # --- faults --------------------------------------------------------------------------------------

    def _faults_session(self) -> zenoh.Session:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([self._control]))
        config.insert_json5("scouting/multicast/enabled", "false")
        return zenoh.open(config)

    def _begin(self, fault: ChaosFault, faults: zenoh.Session) -> None:
        now_s = time.monotonic()
        self._faults[fault.name] += 1
        self._last_fault = fault.name
        self._over_s = max(self._over_s, now_s + fault.lasts_s)
        self._loads.append(os.getloadavg()[0])
        self._say(f"fault: {fault.what} ({fault.target}), load {self._loads[-1]:.1f}")
        if fault.target == "vehicle":
            replies = faults.get(
                f"mavlink_sim/{self._vehicle.system_id}/fault", payload=fault.what, timeout=10.0
            )
            for reply in replies:
                if reply.ok is not None and _body(reply.ok).get("ok"):
                    return
            self._problems.append(f"the simulator did not take {fault.what!r}")
        elif fault.target in ("worker", "service"):
            pid = self._service.pid if fault.target == "service" else self._worker_pid
            number = signal.Signals[fault.what]
            if pid is None or not _kill(pid, number):
                self._problems.append(f"there was no {fault.target} for {fault.what}")
            elif number is signal.SIGSTOP:
                self._undo.append((now_s + fault.lasts_s, partial(_kill, pid, signal.SIGCONT)))
        elif fault.target == "clock":
            set_step(self._clock, _HOUR_S if fault.what.startswith("+") else -_HOUR_S)
            self._undo.append((now_s + fault.lasts_s, partial(set_step, self._clock, 0.0)))
        else:
            size = min(round(_free_memory() * _MEMORY_SHARE), _MEMORY_MOST_MB * 1_000_000)
            child = subprocess.Popen([sys.executable, "-c", _ALLOCATES, str(size), str(fault.lasts_s)])
            self._undo.append((now_s + fault.lasts_s + 5.0, partial(_end_child, child)))

    def _step(self) -> None:
        """Wait a little, and end the faults that are due."""
        time.sleep(_POLL_S)
        now_s = time.monotonic()
        for due in [each for each in self._undo if each[0] <= now_s]:
            self._undo.remove(due)
            due[1]()
        if self._service.returncode is not None:
            raise SimSessionError(f"the service ended with exit code {self._service.returncode}")

    def _until_over(self) -> None:
        while self._undo or time.monotonic() < self._over_s:
            self._step()

    def _until(self, condition: Callable[[], bool], seconds: float, otherwise: str) -> None:
        until_s = time.monotonic() + seconds
        while not condition():
            self._step()
            if time.monotonic() > until_s:
                raise SimSessionError(f"{otherwise} within {seconds:g} s")

    # --- measurement ---------------------------------------------------------------------------------

    def _renew_worker(self) -> None:
        """End the worker, so that its age is the same at both measurements."""
        before = self._worker_pid
        if before is not None:
            _kill(before, signal.SIGKILL)
        self._until(
            lambda: self._worker_pid not in (None, before) and self._ready,
            _READY_S,
            "no new worker was ready",
        )

    def _measured(self) -> dict[str, Figures]:
        """Measure on the ground, when all faults are over."""
        self._until_over()
        time.sleep(_SETTLED_S)
        self._loads.append(os.getloadavg()[0])
        return settled_figures(self._service.pid, seconds=_SETTLED_S)

    async def end(self) -> None:
        """End everything that was started, whatever was done to it."""
        for _, undo in self._undo:
            undo()
        with suppress(ProcessLookupError):
            os.killpg(self._service.pid, signal.SIGCONT)
            self._service.terminate()
        try:
            async with asyncio.timeout(15.0):
                await self._service.wait()
        except TimeoutError:
            with suppress(ProcessLookupError):
                os.killpg(self._service.pid, signal.SIGKILL)
            await self._service.wait()


def _body(sample: zenoh.Sample) -> dict[str, Any]:
    body: dict[str, Any] = json.loads(copy_payload(sample.payload, _LARGEST_BODY))
    return body


def _kill(pid: int, number: signal.Signals) -> bool:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def _end_child(child: subprocess.Popen[bytes]) -> None:
    child.kill()
    child.wait()


def _free_memory() -> int:
    """Return the bytes that can be allocated without swapping."""
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return 0
