"""Mutated MAVLink thrown at a vehicle: whatever arrives, it flies on, answers, and keeps its time.

`python -m mavlink_sim.fuzz --minutes 10` starts a vehicle in a process of its own, floods both of its sockets
and asks it all the while whether it is well. Before that, a vehicle in lockstep takes a share of the same.
Everything follows from the seed, which is printed.
"""

from __future__ import annotations

import argparse
import itertools
import random
import resource
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pymavlink.generator.mavcrc import x25crc

from mavlink_sim.services.microservices import HANDLERS
from mavlink_sim.testing import RunningSimulator, running_simulator
from mavlink_sim.vehicle import STEP_S, Vehicle
from mavlink_sim.wire.messages import dialect, parser

SOURCES = ((1, 191), (245, 190), (1, 1), (0, 0), (255, 255), (7, 1))
SPECIAL_FLOATS = (float("nan"), float("inf"), float("-inf"), 0.0, -0.0, 1e38, -1e38, 1e-45, 1.0, 21196.0)
SPECIAL_INTEGERS = (
    0,
    1,
    2,
    127,
    128,
    255,
    256,
    32767,
    32768,
    65535,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63,
    2**64 - 1,
)
# Commands worth more than chance: those with handlers of their own somewhere in PX4.
COMMANDS: tuple[int, ...] = (
    *(16, 17, 19, 20, 21, 22, 34, 84, 85, 92, 176, 177, 178, 179, 183, 184, 185, 186, 187, 189, 192, 193),
    *(195, 197, 201, 205, 206, 211, 241, 245, 246, 252, 300, 400, 401, 410, 420, 500, 510, 511, 512, 519),
    *(520, 521, 1000, 1001, 2000, 2001, 2500, 3000, 4000, 5000, 5001, 31010, 43000, 60000),
)
# Not sent to a vehicle whose answers are watched: SETUP_SIGNING would, rightly, end the conversation.
LEFT_OUT = frozenset({256})
REQUEST_EVENT = (412, 33, struct.Struct("<HHBB"))
# A vehicle that says nothing for so long is dead, on however busy a machine.
ANSWER_LIMIT_S = 30.0


class Fuzzer:
    """An endless, seeded source of datagrams: whole frames, and damaged ones."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._sequence = itertools.count()
        self._kinds = sorted(set(dialect.mavlink_map) - LEFT_OUT)
        self._handled = [number for number in self._kinds if dialect.mavlink_map[number].msgname in HANDLERS]
        self.thrown: Counter[str] = Counter()

    def datagrams(self) -> Iterator[bytes]:
        """One datagram after the other, for ever."""
        while True:
            kind = self._random.choices(
                ("frame", "bit flips", "truncated", "several", "random bytes", "old version", "burst"),
                (60, 12, 8, 8, 6, 4, 2),
            )[0]
            self.thrown[kind] += 1
            yield from self._of(kind)

    def _of(self, kind: str) -> Iterator[bytes]:
        chance = self._random
        if kind == "random bytes":
            yield chance.randbytes(chance.choice((0, 1, 12, 280, 1400, 9000)))
        elif kind == "burst":
            frame = self._frame()
            yield from itertools.repeat(frame, chance.randrange(20, 300))
        elif kind == "several":
            yield b"".join(self._frame() for _ in range(chance.randrange(2, 12)))[:9000]
        elif kind == "old version":
            yield self._frame(old=True)
        else:
            damaged = bytearray(self._frame())
            if kind == "bit flips":
                for _ in range(chance.randrange(1, 9)):
                    damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
            elif kind == "truncated":
                del damaged[chance.randrange(len(damaged)) :]
            yield bytes(damaged)

    def _frame(self, old: bool = False) -> bytes:
        """A frame with a right checksum and wild fields."""
        chance = self._random
        if chance.random() < 0.02:
            number, extra, layout = REQUEST_EVENT
            wanted = layout.pack(chance.randrange(65536), chance.randrange(65536), 1, 1)
            return self._sealed(number, extra, wanted, False)
        number = chance.choice(self._handled if chance.random() < 0.7 else self._kinds)
        message = dialect.mavlink_map[number]
        payload = bytearray(self._payload(message))
        old = old and number < 256
        if not old and chance.random() < 0.2:  # MAVLink 2 cuts trailing zeros; wrong lengths come too
            del payload[max(chance.randrange(len(payload) + 1), 1) :]
        elif not old and chance.random() < 0.05:
            payload += chance.randbytes(chance.randrange(256 - len(payload)))
        return self._sealed(number, message.crc_extra, bytes(payload), old)

    def _sealed(self, number: int, crc_extra: int, payload: bytes, old: bool) -> bytes:
        system, component = self._random.choice(SOURCES)
        sequence = next(self._sequence) & 0xFF
        if old:
            body = struct.pack("<BBBBB", len(payload), sequence, system, component, number) + payload
        else:
            compatible = (
                self._random.choice((0, 0, 0, 0, 0, 0, 0, 1, 2, 255)) if self._random.random() < 0.1 else 0
            )
            head = (len(payload), compatible, 0, sequence, system, component, number & 0xFFFF, number >> 16)
            body = struct.pack("<BBBBBBHB", *head) + payload
        crc = x25crc(body)
        crc.accumulate(bytes([crc_extra]))
        tail = self._random.randbytes(13) if not old and body[1] & 1 else b""
        return (b"\xfe" if old else b"\xfd") + body + struct.pack("<H", crc.crc) + tail

    def _payload(self, message: type) -> bytes:
        packed = b""
        for name, code, length in zip(
            message.ordered_fieldnames,  # type: ignore[attr-defined]
            message.native_format.decode()[1:],  # type: ignore[attr-defined]
            message.lengths,  # type: ignore[attr-defined]
            strict=True,
        ):
            for _ in range(max(length, 1)):
                packed += self._number(name, code)
        return packed

    def _number(self, name: str, code: str) -> bytes:
        chance = self._random
        if code in "fd":
            if name == "param1" and chance.random() < 0.3:
                return struct.pack("<" + code, float(chance.randrange(0, 440)))
            value = chance.choice(SPECIAL_FLOATS) if chance.random() < 0.4 else chance.uniform(-400.0, 400.0)
            return struct.pack("<" + code, value)
        size = struct.calcsize("<" + code)
        if name in ("target_system", "target_component") and chance.random() < 0.8:
            number = 1
        elif name == "command" and chance.random() < 0.9:
            number = chance.choice(COMMANDS)
        elif name in ("seq", "count", "mission_type", "frame", "coordinate_frame") and chance.random() < 0.7:
            number = chance.randrange(0, 12)
        elif code == "c" and chance.random() < 0.8:
            number = ord(chance.choice("ABCDEFGHIJKLMNOPQRSTUVWXYZ_0123456789/\0\0"))
        elif chance.random() < 0.4:
            number = chance.choice(SPECIAL_INTEGERS)
        else:
            number = chance.getrandbits(8 * size)
        return (number & (1 << 8 * size) - 1).to_bytes(size, "little")


# ---- in process -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LockstepReport:
    """What a vehicle in lockstep went through. Seconds are of the processor's time."""

    datagrams: int
    messages: int
    simulated_s: float
    slowest_step_s: float
    slowest_message: tuple[float, str]


def fuzz_in_lockstep(seed: int, datagrams: int) -> LockstepReport:
    """Throw datagrams at a flying vehicle in lockstep; whatever it cannot bear is raised."""
    vehicle = Vehicle(ready_after_s=0.0)
    for name in ("onboard", "gcs"):
        vehicle.add_link(name)
    vehicle.autopilot.arm()
    vehicle.autopilot.takeoff(20.0)
    readers = {name: parser() for name in vehicle.links}
    writer = parser()
    source = Fuzzer(seed).datagrams()
    taken = 0
    slowest_step_s, slowest_message = 0.0, (0.0, "")
    for number in range(datagrams):
        link = "gcs" if number % 3 == 0 else "onboard"
        datagram = next(source)
        for message in readers[link].parse_buffer(datagram) or []:
            if message.get_type() == "BAD_DATA":
                continue
            taken += 1
            began_s = time.process_time()
            vehicle.handle(link, message)
            slowest_message = max(slowest_message, (time.process_time() - began_s, message.get_type()))
        began_s = time.process_time()
        vehicle.step(STEP_S)
        for name in vehicle.links:
            for item in vehicle.outgoing(name):
                item.pack(writer)
        slowest_step_s = max(slowest_step_s, time.process_time() - began_s)
    return LockstepReport(datagrams, taken, vehicle.now_s, slowest_step_s, slowest_message)


# ---- over sockets -----------------------------------------------------------------------------------------


@dataclass(slots=True)
class SocketReport:
    """What a running vehicle went through.

    Attributes:
        pings, answers: questions asked of it meanwhile, and answers to them.
        answer_s: how long the answers took (wall time).
        boot_s, wall_s: how far its clock and ours went.
        idle_load, load: its processor time a second before the flood, and in it.
        said: what it printed about itself (its events and warnings).
    """

    seed: int
    datagrams: int = 0
    sent_bytes: int = 0
    pings: int = 0
    answers: int = 0
    answer_s: list[float] = field(default_factory=list)
    boot_s: float = 0.0
    wall_s: float = 0.0
    idle_load: float = 0.0
    load: float = 0.0
    memory_kb: int = 0
    said: Counter[str] = field(default_factory=Counter)

    def text(self) -> str:
        ordered = sorted(self.answer_s) or [0.0]
        shown = {
            share: ordered[min(int(share * len(ordered)), len(ordered) - 1)] for share in (0.5, 0.99, 1.0)
        }
        return (
            f"seed {self.seed}: {self.datagrams} datagrams, {self.sent_bytes / 1e6:.1f} MB "
            f"in {self.wall_s:.0f} s; "
            f"{self.answers} of {self.pings} questions answered, median {shown[0.5] * 1e3:.1f} ms, "
            f"99 % {shown[0.99] * 1e3:.1f} ms, slowest {shown[1.0] * 1e3:.1f} ms; "
            f"its clock went {self.boot_s:.1f} s; processor load {self.idle_load:.0%} idle, "
            f"{self.load:.0%} in the flood; "
            f"memory {self.memory_kb / 1024:.0f} MiB"
        )


def fuzz_over_sockets(seed: int, seconds: float, rate_hz: float = 400.0) -> SocketReport:
    """Flood both sockets of a vehicle in a process of its own, asking it five times a second if it is well.

    Raises RuntimeError if it ends, or does not answer within ANSWER_LIMIT_S at the end.
    """
    report = SocketReport(seed)
    with running_simulator() as simulator, _Examiner(simulator) as examiner:
        examiner.wait_answer(30.0)
        before_s, started_s = _processor_s(simulator.pid), time.monotonic()
        while time.monotonic() - started_s < min(3.0, seconds):
            examiner.receive(0.05)
        report.idle_load = (_processor_s(simulator.pid) - before_s) / (time.monotonic() - started_s)
        _flood(report, simulator, examiner, seconds, rate_hz)
        examiner.wait_answer(ANSWER_LIMIT_S)
        report.pings, report.answers, report.answer_s = (
            examiner.asked,
            len(examiner.answer_s),
            examiner.answer_s,
        )
        report.memory_kb = _memory_kb(simulator.pid)
        if simulator.process.poll() is not None:
            raise RuntimeError(f"the vehicle ended: {simulator.events[-5:]}")
        report.said = Counter(line.split(":")[0] for line in simulator.events)
        failures = [line for line in simulator.events if "Traceback" in line]
        if failures:
            raise RuntimeError(f"the vehicle failed: {simulator.events[-20:]}")
    return report


def _flood(
    report: SocketReport, simulator: RunningSimulator, examiner: _Examiner, seconds: float, rate_hz: float
) -> None:
    source = Fuzzer(report.seed).datagrams()
    ground_station = ("127.0.0.1", simulator.gcs_bind)
    before_s, started_s = _processor_s(simulator.pid), time.monotonic()
    booted_s = examiner.boot_s
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as attacker:
        while (elapsed_s := time.monotonic() - started_s) < seconds:
            while report.datagrams < elapsed_s * rate_hz:
                datagram = next(source)
                if report.datagrams % 3 == 0:
                    attacker.sendto(datagram, ground_station)
                else:
                    examiner.send(datagram)
                report.datagrams += 1
                report.sent_bytes += len(datagram)
            examiner.receive(1.0 / rate_hz)
            if simulator.process.poll() is not None:
                raise RuntimeError(f"the vehicle ended after {report.datagrams}: {simulator.events[-5:]}")
    report.wall_s = time.monotonic() - started_s
    examiner.wait_answer(ANSWER_LIMIT_S)
    report.boot_s = examiner.boot_s - booted_s
    report.load = (_processor_s(simulator.pid) - before_s) / report.wall_s


class _Examiner:
    """The rightful client of the onboard link: it asks TIMESYNC five times a second and takes the time."""

    def __init__(self, simulator: RunningSimulator) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", simulator.onboard_port))
        self._target = ("127.0.0.1", simulator.onboard_bind)
        self._codec, self._reader = parser(1, 191), parser()
        self._asked_s: dict[int, float] = {}
        self._next_s = 0.0
        self.asked = 0
        self.boot_s = 0.0
        self.answer_s: list[float] = []

    def __enter__(self) -> _Examiner:
        return self

    def __exit__(self, *exception: object) -> None:
        self._socket.close()

    def send(self, datagram: bytes) -> None:
        """From the same address as the questions, so that the vehicle never takes another correspondent."""
        self._socket.sendto(datagram, self._target)

    def receive(self, seconds: float) -> None:
        """Read for that long; ask when it is time to."""
        deadline_s = time.monotonic() + seconds
        while True:
            now_s = time.monotonic()
            if now_s >= self._next_s:
                self._next_s = now_s + 0.2
                self.asked += 1
                self._asked_s[self.asked] = now_s
                packed = dialect.MAVLink_timesync_message(0, self.asked).pack(self._codec)
                self._socket.sendto(packed, self._target)
            if now_s >= deadline_s:
                return
            self._socket.settimeout(deadline_s - now_s)
            try:
                datagram = self._socket.recv(65535)
            except TimeoutError:
                return
            if datagram[7:10] == b"\x6f\x00\x00":  # TIMESYNC; the rest would only cost us time
                for message in self._reader.parse_buffer(datagram) or []:
                    if message.get_type() == "TIMESYNC" and message.tc1 and message.ts1 in self._asked_s:
                        self.answer_s.append(time.monotonic() - self._asked_s.pop(message.ts1))
                        self.boot_s = message.tc1 / 1e9

    def wait_answer(self, limit_s: float) -> None:
        """Until one more answer. Raises RuntimeError where none comes."""
        count, deadline_s = len(self.answer_s), time.monotonic() + limit_s
        while len(self.answer_s) == count:
            if time.monotonic() > deadline_s:
                raise RuntimeError(f"the vehicle has not answered for {limit_s:g} s")
            self.receive(0.05)


def _processor_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


def _memory_kb(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize() // 1024


def main() -> None:
    """Fuzz in lockstep, then over sockets; print what was found."""
    arguments = argparse.ArgumentParser(description="Throw mutated MAVLink at the built-in vehicle.")
    arguments.add_argument("--minutes", type=float, default=10.0, help="over sockets")
    arguments.add_argument("--datagrams", type=int, default=20_000, help="in lockstep")
    arguments.add_argument("--rate", type=float, default=400.0, help="datagrams a second over sockets")
    arguments.add_argument("--seed", type=int, default=None)
    options = arguments.parse_args()
    seed = random.randrange(2**32) if options.seed is None else options.seed
    print(f"seed {seed}", flush=True)
    print(fuzz_in_lockstep(seed, options.datagrams), flush=True)
    report = fuzz_over_sockets(seed, options.minutes * 60.0, options.rate)
    print(report.text())
    for line, count in report.said.most_common(20):
        print(f"    {count} x {line}")


if __name__ == "__main__":
    main()
