"""Mutated MAVLink sent to a simulated vehicle: it must fly on, answer, and keep its time.

`python -m tools.fuzz_simulator --minutes 10` starts a vehicle in a separate process, floods both of its
sockets and checks its state meanwhile. Before that, a vehicle in lockstep takes a share of the same.
Everything follows from the seed, which is printed. `--autopilot ardupilot`, `--gimbal` and `--signed` choose
another vehicle; on a signed link half of the whole frames have a right signature. The exit code is 1 where
the vehicle could not keep up.
"""

from __future__ import annotations

import argparse
import itertools
import random
import resource
import socket
import struct
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from pymavlink.generator.mavcrc import x25crc

from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.testing import RunningSimulator, running_simulator
from mavlink_sim.vehicles.firmware import AUTOPILOTS, PX4, vehicle_class
from mavlink_sim.vehicles.vehicle import STEP_S
from mavlink_sim.wire.messages import dialect, parser
from mavlink_sim.wire.signing import ALWAYS, Signing, timestamp_now
from mavlink_sim.wire.streams import ONBOARD_RATES_HZ

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
KEY = bytes(range(32))
CLIENTS_LINK, ATTACKERS_LINK = 7, 8  # link ids in signatures


@dataclass(frozen=True, slots=True)
class Target:
    """What kind of vehicle is thrown at: whose autopilot, with a gimbal or not, on signed links or not."""

    autopilot: str = PX4
    gimbal: bool = False
    signed: bool = False

    @property
    def handlers(self) -> Collection[str]:
        """The names of the messages that it does something with."""
        return vehicle_class(self.autopilot).handlers.keys()

    def signing(self, link_id: int) -> Signing | None:
        """Of one who knows the vehicle's key; None without one."""
        if not self.signed:
            return None
        signing = Signing(link_id)
        signing.set_up(KEY, timestamp_now())
        return signing


class Fuzzer:
    """An endless, seeded source of datagrams: whole frames, and damaged ones.

    Signatures bear the time of day: where the target is signed, they alone do not follow from the seed.
    """

    def __init__(self, seed: int, target: Target | None = None) -> None:
        target = target or Target()
        self._random = random.Random(seed)
        self._signing = target.signing(ATTACKERS_LINK)
        self._sequence = itertools.count()
        self._kinds = sorted(set(dialect.mavlink_map) - LEFT_OUT)
        self._handled = [
            number for number in self._kinds if dialect.mavlink_map[number].msgname in target.handlers
        ]
        self.thrown: Counter[str] = Counter()

    def datagrams(self) -> Iterator[bytes]:
        """One datagram after the other; never returns."""
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
            frame = self._unsigned_frame()
            count = chance.randrange(20, 300)
            knows_key = self._knows_key()
            for _ in range(count):  # each with a signature of its own: a repeated one is refused
                yield self._sealed(frame, knows_key)
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

    def _knows_key(self) -> bool:
        return self._signing is not None and self._random.random() < 0.5

    def _sealed(self, frame: bytes, knows_key: bool) -> bytes:
        return self._signing.signed(frame) if knows_key and self._signing is not None else frame

    def _frame(self, old: bool = False) -> bytes:
        frame = self._unsigned_frame(old)
        return self._sealed(frame, self._knows_key())

    def _unsigned_frame(self, old: bool = False) -> bytes:
        """A frame with a right checksum and wild fields."""
        chance = self._random
        if chance.random() < 0.02:
            number, extra, layout = REQUEST_EVENT
            wanted = layout.pack(chance.randrange(65536), chance.randrange(65536), 1, 1)
            return self._packed(number, extra, wanted, False)
        number = chance.choice(self._handled if chance.random() < 0.7 else self._kinds)
        message = dialect.mavlink_map[number]
        payload = bytearray(self._payload(message))
        old = old and number < 256
        if not old and chance.random() < 0.2:  # MAVLink 2 cuts trailing zeros; wrong lengths come too
            del payload[max(chance.randrange(len(payload) + 1), 1) :]
        elif not old and chance.random() < 0.05:
            payload += chance.randbytes(chance.randrange(256 - len(payload)))
        return self._packed(number, message.crc_extra, bytes(payload), old)

    def _packed(self, number: int, crc_extra: int, payload: bytes, old: bool) -> bytes:
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
    """What a vehicle in lockstep went through. Seconds are of the processor's time.

    Attributes:
        messages: whole ones that reached it. refused: whole ones that their signature kept from it.
    """

    datagrams: int
    messages: int
    refused: int
    simulated_s: float
    slowest_step_s: float
    slowest_message: tuple[float, str]


def fuzz_in_lockstep(seed: int, datagrams: int, target: Target | None = None) -> LockstepReport:
    """Throw datagrams at a flying vehicle in lockstep; whatever it cannot bear is raised."""
    target = target or Target()
    links = {"onboard": ONBOARD_RATES_HZ, "gcs": ONBOARD_RATES_HZ}
    flown = LockstepVehicle(links, autopilot=target.autopilot, gimbal=target.gimbal, ready_after_s=0.0)
    flown.take_off(20.0)
    vehicle = flown.vehicle
    if target.signed:
        vehicle.sign_everything(KEY)
        if target.autopilot == PX4:
            vehicle.parameters.set("MAV_SIGN_CFG", ALWAYS)
    readers = {name: parser() for name in vehicle.links}
    writer = parser()
    source = Fuzzer(seed, target).datagrams()
    began_at_s = vehicle.faults.now_s  # a clock that goes on through reboots
    taken = refused = 0
    slowest_step_s, slowest_message = 0.0, (0.0, "")
    for number in range(datagrams):
        link = "gcs" if number % 3 == 0 else "onboard"
        datagram = next(source)
        for message in readers[link].parse_buffer(datagram) or []:
            if message.get_type() == "BAD_DATA":
                continue
            if not vehicle.links[link].signing.accepts(message.get_msgbuf()):
                refused += 1
                continue
            taken += 1
            began_s = time.process_time()
            vehicle.handle(link, message)
            slowest_message = max(slowest_message, (time.process_time() - began_s, message.get_type()))
        began_s = time.process_time()
        vehicle.step(STEP_S)
        for name in vehicle.links:
            for item in vehicle.outgoing(name):
                vehicle.links[name].signing.signed(item.pack(writer))
        slowest_step_s = max(slowest_step_s, time.process_time() - began_s)
    simulated_s = vehicle.faults.now_s - began_at_s
    return LockstepReport(datagrams, taken, refused, simulated_s, slowest_step_s, slowest_message)


# ---- over sockets -----------------------------------------------------------------------------------------


@dataclass(slots=True)
class SocketReport:
    """What a running vehicle went through.

    Attributes:
        pings, answers: questions asked of it meanwhile, and answers to them.
        answer_s: how long the answers took (wall time).
        boot_s, wall_s: how far its clock and ours went between two of its answers.
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
    flood_s: float = 0.0
    idle_load: float = 0.0
    load: float = 0.0
    memory_kb: int = 0
    said: Counter[str] = field(default_factory=Counter)

    @property
    def kept_up(self) -> bool:
        """Whether the vehicle, which watches its own loop, never had to say that it cannot keep up."""
        return not self.said["cannot keep up"]

    def text(self) -> str:
        ordered = sorted(self.answer_s) or [0.0]
        shown = {
            share: ordered[min(int(share * len(ordered)), len(ordered) - 1)] for share in (0.5, 0.99, 1.0)
        }
        return (
            f"seed {self.seed}: {self.datagrams} datagrams, {self.sent_bytes / 1e6:.1f} MB "
            f"in {self.flood_s:.0f} s; "
            f"{self.answers} of {self.pings} questions answered, median {shown[0.5] * 1e3:.1f} ms, "
            f"99 % {shown[0.99] * 1e3:.1f} ms, slowest {shown[1.0] * 1e3:.1f} ms; "
            f"its clock went {self.boot_s:.2f} of {self.wall_s:.2f} s and it "
            f"{'kept up' if self.kept_up else 'COULD NOT KEEP UP'}; "
            f"processor load {self.idle_load:.0%} idle, "
            f"{self.load:.0%} in the flood; "
            f"memory {self.memory_kb / 1024:.0f} MiB"
        )


def fuzz_over_sockets(
    seed: int, seconds: float, rate_hz: float = 400.0, target: Target | None = None
) -> SocketReport:
    """Flood both sockets of a vehicle in a process of its own, asking it five times a second if it is well.

    Raises RuntimeError if it ends, or does not answer within ANSWER_LIMIT_S at the end.
    """
    target = target or Target()
    report = SocketReport(seed)
    options = {
        "autopilot": target.autopilot,
        "gimbal": target.gimbal,
        "signing_key": KEY.hex() if target.signed else None,
    }
    with (
        running_simulator(**options) as simulator,  # type: ignore[arg-type]
        _Examiner(simulator, target.signing(CLIENTS_LINK)) as examiner,
    ):
        examiner.wait_answer(30.0)
        before_s, started_s = _processor_s(simulator.pid), time.monotonic()
        while time.monotonic() - started_s < min(3.0, seconds):
            examiner.receive(0.05)
        report.idle_load = (_processor_s(simulator.pid) - before_s) / (time.monotonic() - started_s)
        _flood(report, simulator, examiner, seconds, rate_hz, target)
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
    report: SocketReport,
    simulator: RunningSimulator,
    examiner: _Examiner,
    seconds: float,
    rate_hz: float,
    target: Target,
) -> None:
    source = Fuzzer(report.seed, target).datagrams()
    ground_station = ("127.0.0.1", simulator.gcs_bind)
    before_s, started_s = _processor_s(simulator.pid), time.monotonic()
    booted_s, booted_at_s = examiner.boot_s, examiner.received_at_s
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
    report.flood_s = time.monotonic() - started_s
    report.load = (_processor_s(simulator.pid) - before_s) / report.flood_s
    examiner.wait_answer(ANSWER_LIMIT_S)
    report.boot_s = examiner.boot_s - booted_s
    report.wall_s = examiner.received_at_s - booted_at_s


class _Examiner:
    """The rightful client of the onboard link: it asks TIMESYNC five times a second and takes the time."""

    def __init__(self, simulator: RunningSimulator, signing: Signing | None) -> None:
        self._signing = signing
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", simulator.onboard_port))
        self._target = ("127.0.0.1", simulator.onboard_bind)
        self._codec, self._reader = parser(1, 191), parser()
        self._asked_s: dict[int, float] = {}
        self._next_s = 0.0
        self.asked = 0
        self.boot_s = self.received_at_s = 0.0  # what its clock was in the newest answer, and ours
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
                self._socket.sendto(self._signing.signed(packed) if self._signing else packed, self._target)
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
                        self.received_at_s = time.monotonic()
                        self.answer_s.append(self.received_at_s - self._asked_s.pop(message.ts1))
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
    arguments = argparse.ArgumentParser(description="Throw mutated MAVLink at the simulated vehicle.")
    arguments.add_argument("--minutes", type=float, default=10.0, help="over sockets")
    arguments.add_argument("--datagrams", type=int, default=20_000, help="in lockstep")
    arguments.add_argument("--rate", type=float, default=400.0, help="datagrams a second over sockets")
    arguments.add_argument("--seed", type=int, default=None)
    arguments.add_argument("--autopilot", choices=AUTOPILOTS, default=PX4)
    arguments.add_argument("--gimbal", action="store_true", help="a vehicle with a gimbal")
    arguments.add_argument("--signed", action="store_true", help="links with a signing key")
    options = arguments.parse_args()
    seed = random.randrange(2**32) if options.seed is None else options.seed
    print(f"seed {seed}", flush=True)
    target = Target(options.autopilot, options.gimbal, options.signed)
    if target.gimbal and target.autopilot != PX4:
        arguments.error(f"--gimbal: an {target.autopilot} vehicle has none here")
    print(fuzz_in_lockstep(seed, options.datagrams, target), flush=True)
    report = fuzz_over_sockets(seed, options.minutes * 60.0, options.rate, target)
    print(report.text())
    for line, count in report.said.most_common(20):
        print(f"    {count} x {line}")
    sys.exit(not report.kept_up)


if __name__ == "__main__":
    main()
