"""A recorded flight of a real PX4, flown again by the simulated vehicle, and the two compared.

The companion's half of the recording (everything that did not come from the autopilot) is played to a vehicle
in lockstep, each message at its stamp; what the vehicle answers is held against what PX4 answered then. Run
`python -m tools.recorded_flight FLIGHT.tlog` to see every difference.
"""

from __future__ import annotations

import argparse
import math
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink import mavutil

from mavlink_sim.services.system_streams import PREARM_CHECK
from mavlink_sim.vehicles.vehicle import STEP_S, Vehicle
from mavlink_sim.wire.messages import parser

RATE_TOLERANCE = 0.05  # of the number of messages of a kind, besides two of them
TIME_TOLERANCE_S = 1.0
# Changes that are seen no sooner than their message comes round.
SEEN_LATE_S = {"HEARTBEAT": 2.0, "CURRENT_MODE": 3.0}
# Fields that are clocks or counters: they differ between any two flights.
CLOCKS = frozenset(
    {"time_boot_ms", "time_usec", "time_unix_usec", "timestamp", "ts1", "tc1", "seq", "sequence"}
    | {"event_time_boot_ms", "messages_sent", "messages_received", "param_index", "param_count"}
)
# Of these every pair of flights has its own: what happens is compared by sequence instead.
COMPARED_BY_SEQUENCE = frozenset(
    {"COMMAND_ACK", "COMMAND_LONG", "EVENT", "PARAM_VALUE", "STATUSTEXT", "CURRENT_EVENT_SEQUENCE"}
)

# Messages of PX4's dialect that pymavlink does not decode: their names, layouts and fields.
_UNDECODED: dict[int, tuple[str, struct.Struct, tuple[str, ...]]] = {
    8: (
        "LINK_NODE_STATUS",
        struct.Struct("<QIIIIIHHHBB"),
        (
            *("timestamp", "tx_rate", "rx_rate", "messages_sent", "messages_received", "messages_lost"),
            *("rx_parse_err", "tx_overflows", "rx_overflows", "tx_buf", "rx_buf"),
        ),
    ),
    380: (
        "TIME_ESTIMATE_TO_TARGET",
        struct.Struct("<5i"),
        ("safe_return", "land", "mission_next_item", "mission_end", "commanded_action"),
    ),
    410: (
        "EVENT",
        struct.Struct("<IIHBBB40s"),
        (
            *("id", "event_time_boot_ms", "sequence", "destination_component", "destination_system"),
            *("log_levels", "arguments"),
        ),
    ),
    411: ("CURRENT_EVENT_SEQUENCE", struct.Struct("<HB"), ("sequence", "flags")),
}


@dataclass(frozen=True, slots=True)
class Received:
    """A message of the autopilot: when (seconds since its boot), its kind, its fields, and was it signed."""

    time_s: float
    kind: str
    fields: dict[str, Any]
    signed: bool


@dataclass(frozen=True, slots=True)
class Flight:
    """A recorded flight: what the autopilot said, and (time since its boot, message) of everybody else."""

    received: list[Received]
    sent: list[tuple[float, Any]]


@dataclass(frozen=True, slots=True, order=True)
class Difference:
    """One kind of difference. `key` names it for good, `found` says what it was this time."""

    key: str
    found: str


# ---- reading and flying -----------------------------------------------------------------------------------


def read_flight(path: Path) -> Flight:
    """Read a tlog of one vehicle (system 1, component 1). Raises ValueError if it holds no ATTITUDE."""
    log = mavutil.mavlink_connection(str(path), dialect="development")
    stamped: list[tuple[float, Any]] = []
    booted_s = None
    while (message := log.recv_msg()) is not None:
        stamped.append((message._timestamp, message))
        if booted_s is None and message.get_type() == "ATTITUDE":
            booted_s = message._timestamp - message.time_boot_ms / 1000.0
    if booted_s is None:
        raise ValueError(f"{path} is no recorded flight: it holds no ATTITUDE message")
    received: list[Received] = []
    sent: list[tuple[float, Any]] = []
    for stamp_s, message in stamped:
        found = received_by(stamp_s - booted_s, bytes(message.get_msgbuf()), message)
        if found is not None:
            received.append(found)
        elif message.get_type() != "BAD_DATA":
            sent.append((stamp_s - booted_s, message))
    return Flight(received, sent)


def received_by(time_s: float, frame: bytes, message: Any) -> Received | None:
    """What the autopilot (1/1) said in a frame; None if somebody else did."""
    if frame[0] != 0xFD or (frame[5], frame[6]) != (1, 1):
        return None
    identifier = int.from_bytes(frame[7:10], "little")
    signed = bool(frame[2] & 1)
    if identifier in _UNDECODED:
        name, layout, fields = _UNDECODED[identifier]
        payload = frame[10 : 10 + frame[1]].ljust(layout.size, b"\0")
        return Received(time_s, name, dict(zip(fields, layout.unpack(payload), strict=True)), signed)
    fields_of = message.to_dict()
    return Received(time_s, fields_of.pop("mavpackettype"), fields_of, signed)


def fly_again(flight: Flight, **options: Any) -> list[Received]:
    """What a vehicle answers to the companion's half, by the recording's clock.

    Args:
        options: of `Vehicle`; where nothing else is said, still air, so that the flight repeats itself, and
            sensors that are ready when PX4's were.
    """
    ready_s = next((time_s for time_s, (ready,) in _prearm(flight.received) if ready), 3.0)
    vehicle = Vehicle(**{"gusts_mps": 0.0, "ready_after_s": ready_s, **options})
    vehicle.add_link("onboard")
    codec, reader = parser(), parser()
    answers: list[Received] = []
    began_s, ended_s = flight.received[0].time_s, max(flight.received[-1].time_s, 0.0)
    sent = iter(flight.sent)
    following = next(sent, None)
    while vehicle.now_s < ended_s:
        while following is not None and following[0] <= vehicle.now_s:
            vehicle.handle("onboard", following[1])
            following = next(sent, None)
        vehicle.step(STEP_S)
        for item in vehicle.outgoing("onboard"):
            frame = item.pack(codec)
            (message,) = reader.parse_buffer(frame)
            found = received_by(vehicle.now_s, frame, message)
            if found is not None and found.time_s >= began_s:
                answers.append(found)
    return answers


# ---- comparing --------------------------------------------------------------------------------------------


def compare(theirs: list[Received], ours: list[Received]) -> list[Difference]:
    """Every kind of difference between PX4's answers and the vehicle's, sorted by key."""
    found: list[Difference] = []
    for comparison in (_kinds, _fields, _sequences, _signatures, _trajectories):
        found += comparison(theirs, ours)
    return sorted(found)


def _by_kind(messages: Iterable[Received]) -> dict[str, list[Received]]:
    kinds: dict[str, list[Received]] = {}
    for message in messages:
        kinds.setdefault(message.kind, []).append(message)
    return kinds


def _kinds(theirs: list[Received], ours: list[Received]) -> Iterator[Difference]:
    """Kinds of messages that one side alone sends, and how many of each."""
    real, own = _by_kind(theirs), _by_kind(ours)
    for kind in sorted(real.keys() | own.keys()):
        there, here = len(real.get(kind, ())), len(own.get(kind, ()))
        if not here:
            yield Difference(f"{kind} missing", f"PX4 sent {there}, this vehicle none")
        elif not there:
            yield Difference(f"{kind} unknown", f"this vehicle sent {here}, PX4 none")
        elif kind not in COMPARED_BY_SEQUENCE and abs(here - there) > 2 + RATE_TOLERANCE * there:
            yield Difference(f"{kind} rate", f"PX4 sent {there}, this vehicle {here}")


def _fields(theirs: list[Received], ours: list[Received]) -> Iterator[Difference]:
    """Fields that are constant on one side alone, or never have the values of the other."""
    real, own = _by_kind(theirs), _by_kind(ours)
    for kind in sorted((real.keys() & own.keys()) - COMPARED_BY_SEQUENCE):
        for field in real[kind][0].fields:
            if field in CLOCKS:
                continue
            there = _values(real[kind], field)
            here = _values(own[kind], field)
            if there is None or here is None:
                continue
            yield from _field_difference(f"{kind}.{field}", there, here)


def _values(messages: list[Received], field: str) -> NDArray[np.float64] | None:
    """A row of numbers a message; None where the field is a text or missing."""
    rows = [message.fields.get(field) for message in messages]
    if any(isinstance(row, str | bytes) or row is None for row in rows):
        return None
    return np.array([row if isinstance(row, list | tuple) else [row] for row in rows], dtype=float)


def _field_difference(
    key: str, there: NDArray[np.float64], here: NDArray[np.float64]
) -> Iterator[Difference]:
    def shown(values: NDArray[np.float64]) -> str:
        if _constant(values):
            return _short(values[0])
        return f"{_short(np.nanmin(values, axis=0))} to {_short(np.nanmax(values, axis=0))}"

    text = f"PX4: {shown(there)}; this vehicle: {shown(here)}"
    if _constant(there) != _constant(here):
        yield Difference(f"{key} {'varies' if _constant(there) else 'is constant'}", text)
    elif _constant(there):
        if not np.allclose(there[0], here[0], rtol=1e-5, atol=1e-6, equal_nan=True):
            yield Difference(f"{key} value", text)
    else:
        low, high = np.nanmin(there, axis=0), np.nanmax(there, axis=0)
        span = np.maximum(high - low, 1e-3)
        outside = (np.nanmin(here, axis=0) > high + span) | (np.nanmax(here, axis=0) < low - span)
        moves = high - low > 1e-3
        spread = np.where(moves, (np.nanmax(here, axis=0) - np.nanmin(here, axis=0)) / span, 1.0)
        if np.any(outside):
            yield Difference(f"{key} range", text)
        elif np.any(spread > 5.0) or np.any(spread < 0.2):
            yield Difference(f"{key} spread", text)


def _constant(values: NDArray[np.float64]) -> bool:
    return bool(np.all((values == values[0]) | (np.isnan(values) & np.isnan(values[0]))))


def _short(values: NDArray[np.float64]) -> str:
    shown = [f"{value:.6g}" for value in values[:4]]
    return shown[0] if len(values) == 1 else f"[{', '.join(shown)}{', …' if len(values) > 4 else ''}]"


Entry = tuple[float, tuple[Any, ...]]


def _changes(messages: list[Received], kind: str, *fields: str) -> list[Entry]:
    """When these fields changed, and to what; the first values too."""
    found: list[Entry] = []
    for message in messages:
        if message.kind == kind:
            values = tuple(message.fields[field] for field in fields)
            if not found or found[-1][1] != values:
                found.append((message.time_s, values))
    return found


def _each(messages: list[Received], kind: str, *fields: str) -> list[Entry]:
    return [
        (message.time_s, tuple(message.fields[field] for field in fields))
        for message in messages
        if message.kind == kind
    ]


def _sequences(theirs: list[Received], ours: list[Received]) -> Iterator[Difference]:
    """What happened in which order, and when."""
    watched: list[tuple[str, Callable[..., list[Entry]], tuple[str, ...]]] = [
        ("COMMAND_ACK", _each, ("command", "result", "progress", "target_system", "target_component")),
        ("COMMAND_LONG", _each, ("command", "confirmation", "target_system", "target_component")),
        # each by itself: at 1 Hz it is chance which of two changes in one second is seen alone
        ("HEARTBEAT", _changes, ("custom_mode",)),
        ("HEARTBEAT", _changes, ("base_mode",)),
        ("HEARTBEAT", _changes, ("system_status",)),
        ("CURRENT_MODE", _changes, ("custom_mode", "intended_custom_mode", "standard_mode")),
        ("EXTENDED_SYS_STATE", _changes, ("landed_state", "vtol_state")),
        ("STATUSTEXT", _each, ("severity", "text")),
        ("PARAM_VALUE", _each, ("param_id", "param_value")),
    ]
    for kind, entries, fields in watched:
        name = f"{kind} {fields[0]}" if entries is _changes else kind
        yield from _sequence_difference(name, entries(theirs, kind, *fields), entries(ours, kind, *fields))
    yield from _sequence_difference("SYS_STATUS prearm check", _prearm(theirs), _prearm(ours))
    real = {values[0] for _, values in _each(theirs, "EVENT", "id")}
    own = {values[0] for _, values in _each(ours, "EVENT", "id")}
    for identifier in sorted(real - own):
        yield Difference(f"EVENT {identifier:08x} missing", "PX4 emitted it, this vehicle did not")
    for identifier in sorted(own - real):
        yield Difference(f"EVENT {identifier:08x} unknown", "this vehicle emitted it, PX4 did not")
    mutual = real & own
    there = [
        entry for entry in _each(theirs, "EVENT", "id", "log_levels", "arguments") if entry[1][0] in mutual
    ]
    here = [entry for entry in _each(ours, "EVENT", "id", "log_levels", "arguments") if entry[1][0] in mutual]
    yield from _sequence_difference("EVENT", there, here)


def _prearm(messages: list[Received]) -> list[Entry]:
    """When the vehicle was ready to arm, and when not."""
    found: list[Entry] = []
    for time_s, (health,) in _changes(messages, "SYS_STATUS", "onboard_control_sensors_health"):
        ready = (bool(int(health) & PREARM_CHECK),)
        if not found or found[-1][1] != ready:
            found.append((time_s, ready))
    return found


def _sequence_difference(kind: str, there: list[Entry], here: list[Entry]) -> Iterator[Difference]:
    if [values for _, values in there] != [values for _, values in here]:
        yield Difference(f"{kind} sequence", f"PX4: {_listed(there)}; this vehicle: {_listed(here)}")
        return
    if there:
        latest = max(abs(one - other) for (one, _), (other, _) in zip(there, here, strict=True))
        if latest > SEEN_LATE_S.get(kind.split()[0], TIME_TOLERANCE_S):
            yield Difference(
                f"{kind} times", f"up to {latest:.2f} s apart: PX4: {_listed(there)}; ours: {_listed(here)}"
            )


def _listed(entries: list[Entry]) -> str:
    shown = [f"{time_s:.2f} s {'/'.join(str(value) for value in values)}" for time_s, values in entries]
    return "nothing" if not shown else ", ".join(shown[:12]) + (", …" if len(shown) > 12 else "")


def _signatures(theirs: list[Received], ours: list[Received]) -> Iterator[Difference]:
    there, here = {message.signed for message in theirs}, {message.signed for message in ours}
    if there != here:
        yield Difference("signed", f"PX4: {sorted(there)}; this vehicle: {sorted(here)}")


@dataclass(frozen=True, slots=True)
class Deviation:
    """How far two flights lay apart, over time: root mean square and maximum, of one quantity."""

    quantity: str
    unit: str
    rms: float
    maximum: float
    allowed: float  # of the root mean square; more is a difference


# (quantity, unit, message, fields, allowed rms)
_QUANTITIES = (
    ("horizontal position", "m", "LOCAL_POSITION_NED", ("x", "y"), 0.6),
    ("height", "m", "LOCAL_POSITION_NED", ("z",), 0.4),
    ("horizontal velocity", "m/s", "LOCAL_POSITION_NED", ("vx", "vy"), 0.3),
    ("vertical velocity", "m/s", "LOCAL_POSITION_NED", ("vz",), 0.2),
    ("roll and pitch", "rad", "ATTITUDE", ("roll", "pitch"), 0.05),
    ("yaw", "rad", "ATTITUDE", ("yaw",), 0.1),
)


def deviations(theirs: list[Received], ours: list[Received]) -> list[Deviation]:
    """The two trajectories compared at the recording's stamps."""
    found = []
    for quantity, unit, kind, fields, allowed in _QUANTITIES:
        squares: NDArray[np.float64] | float = 0.0
        for field in fields:
            times, there = _track(theirs, kind, field)
            own_times, here = _track(ours, kind, field)
            apart = there - np.interp(times, own_times, np.unwrap(here) if field == "yaw" else here)
            if field == "yaw":
                apart = np.remainder(apart + math.pi, math.tau) - math.pi
            squares = squares + apart**2
        distance = np.sqrt(squares)
        found.append(
            Deviation(quantity, unit, float(np.sqrt(np.mean(distance**2))), float(distance.max()), allowed)
        )
    return found


def _track(
    messages: list[Received], kind: str, field: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    pairs = [
        (message.fields["time_boot_ms"] / 1000.0, message.fields[field])
        for message in messages
        if message.kind == kind
    ]
    times, values = np.array(pairs, dtype=float).T
    return times, values


def _trajectories(theirs: list[Received], ours: list[Received]) -> Iterator[Difference]:
    for deviation in deviations(theirs, ours):
        if deviation.rms > deviation.allowed:
            yield Difference(
                f"trajectory: {deviation.quantity}",
                f"rms {deviation.rms:.2f} {deviation.unit}, max {deviation.maximum:.2f} {deviation.unit}; "
                f"allowed rms {deviation.allowed} {deviation.unit}",
            )


def main() -> None:
    """Print how the flights differ."""
    arguments = argparse.ArgumentParser(
        description="Fly a recorded PX4 flight again and list every difference."
    )
    arguments.add_argument("flight", type=Path, help="a tlog with both directions")
    flight = read_flight(arguments.parse_args().flight)
    ours = fly_again(flight)
    for difference in compare(flight.received, ours):
        print(f"{difference.key}\n    {difference.found}")
    for deviation in deviations(flight.received, fly_again(flight, noise=0.0)):
        print(f"{deviation.quantity}: rms {deviation.rms:.3f} {deviation.unit}, max {deviation.maximum:.3f}")


if __name__ == "__main__":
    main()
