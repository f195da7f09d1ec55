"""Faults: their grammar, begin, end and report; typed on a console; repeated by the seed."""

from __future__ import annotations

import os
import pty
import select
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.faults.context import FaultTarget
from mavlink_sim.faults.grammar import FaultError, parse_fault
from mavlink_sim.faults.injector import FaultConsole
from mavlink_sim.faults.kinds import EFFECTS, KINDS
from mavlink_sim.faults.schedule import Outcome
from mavlink_sim.vehicles.vehicle import STEP_S, Vehicle
from mavlink_sim.wire.messages import dialect, parser
from tests.mavlink_sim.conftest import SimHarness


class LockstepLink:
    """The client's end of one link. Call `receive` after every step: it also advances the link's time."""

    def __init__(self, vehicle: FaultTarget, name: str) -> None:
        self._vehicle = vehicle
        self._name = name
        self._stage = vehicle.faults.stage(name)
        self._codec = parser(vehicle.system_id)
        self._sequences: dict[tuple[int, int], int] = {}

    def send(self, message: Any, source: tuple[int, int] = (1, 191)) -> None:
        """Send a message from a (system, component), with that component's sequence number."""
        codec = parser(*source)
        codec.seq = self._sequences.get(source, 0)
        self._sequences[source] = (codec.seq + 1) % 256
        self.send_bytes(bytes(message.pack(codec)))

    def send_bytes(self, datagram: bytes) -> None:
        """Send one datagram."""
        self._stage.inbound.push(self._vehicle.faults.now_s, datagram)
        self._deliver()

    def receive(self) -> list[bytes]:
        """The datagrams received since the last call; due datagrams to the vehicle are delivered too."""
        self._deliver()
        now_s = self._vehicle.faults.now_s
        for item in self._vehicle.outgoing(self._name):
            self._stage.outbound.push(now_s, item.pack(self._codec))
        return [datagram for datagram, _ in self._stage.outbound.due(now_s)]

    def _deliver(self) -> None:
        for datagram, _ in self._stage.inbound.due(self._vehicle.faults.now_s):
            for message in self._codec.parse_buffer(datagram) or []:
                if message.get_type() != "BAD_DATA":
                    self._vehicle.handle(self._name, message)


def fly(harness: SimHarness, link: LockstepLink, seconds: float) -> list[tuple[float, bytes]]:
    """What a client gets, and when."""
    got = []
    for _ in range(round(seconds / STEP_S)):
        harness.vehicle.step(STEP_S)
        got += [(harness.vehicle.faults.now_s, datagram) for datagram in link.receive()]
    return got


def decoded(datagrams: list[tuple[float, bytes]]) -> list[Any]:
    codec = parser()
    return [message for _, data in datagrams for message in codec.parse_buffer(data) or []]


def test_a_fault_begins_and_ends_at_its_time(harness: SimHarness) -> None:
    faults = harness.vehicle.faults
    number = faults.begin("heartbeat_only", at_s=2.0, duration_s=3.0)
    assert [one.number for one in faults.scheduled] == [number]
    harness.until(lambda: bool(faults.active), 5.0)
    assert faults.now_s == pytest.approx(2.0, abs=STEP_S)
    (active,) = faults.active
    assert harness.events[-1] == f"fault {active} begins"
    harness.until(lambda: not faults.active, 5.0)
    assert faults.now_s == pytest.approx(5.0, abs=STEP_S)
    assert harness.events[-1] == f"fault {active} ends"


def test_faults_are_ended_by_number_by_name_and_all_together(harness: SimHarness) -> None:
    faults = harness.vehicle.faults
    numbers = [faults.begin(line) for line in ("link_delay 0.1", "link_delay 0.2", "wind 3", "stall at=99")]
    assert faults.end(numbers[0]) == 1
    assert faults.end("link_delay") == 1
    assert faults.end() == 2
    assert faults.end("all") == 0
    assert faults.listing() == ["no faults"]
    with pytest.raises(FaultError, match="fault 1 "):
        faults.end(1)


def test_values_as_python_arguments(harness: SimHarness) -> None:
    faults = harness.vehicle.faults
    faults.begin("packet_loss", 0.25, link="gcs", way="out", duration_s=2.0, seed=5)
    assert str(faults.active[0]) == "1 packet_loss 0.25 link=gcs way=out for=2"
    assert faults.active[0].seed == 5


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("link_loss link=usb", "'usb'; .*: all, onboard, gcs"),
        ("wind 3 at=0.5", r"at=0\.5 "),
    ],
)
def test_a_fault_that_cannot_begin_is_refused_at_once(harness: SimHarness, line: str, message: str) -> None:
    harness.fly(1.0)
    with pytest.raises(FaultError, match=message):
        harness.vehicle.faults.begin(line)
    assert harness.vehicle.faults.listing() == ["no faults"]


def test_scheduled_fault_that_fails_is_reported(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    harness.vehicle.faults.begin("pilot_takeover MISSION at=5")
    harness.until(lambda: any("did not begin" in event for event in harness.events), 5.0)
    assert not harness.vehicle.faults.active


def test_grammar_commands_return_text(harness: SimHarness) -> None:
    command = harness.vehicle.faults.command
    assert command("list").text == "no faults"
    assert command("link_delay 0.2 for=3").text == "fault 1 link_delay 0.2 for=3"
    assert command("gust 5 at=9").text == "fault 2 gust 5 at 9 s"
    assert command("list").text.splitlines() == [
        "1 link_delay 0.2 for=3: since 0.0 s, 3.0 s left",
        "2 gust 5: begins at 9 s",
    ]
    assert "link_delay SECONDS" in command("help link_delay").text
    assert len(command("help").text.splitlines()) > 20
    refused = command("link_delay")
    assert not refused.ok
    assert "needs seconds" in refused.text
    assert command("end all").text == "ended 2"
    assert not command("end 7").ok
    assert not command("end").ok
    assert not command("help nothing").ok


def test_the_same_seed_has_the_same_faults_to_the_byte() -> None:
    def flight(seed: int) -> list[tuple[float, bytes]]:
        harness = SimHarness(["everything"], seed=seed)
        link = LockstepLink(harness.vehicle, "onboard")
        for line in (
            "packet_loss 0.2",
            "corrupt 0.1",
            "link_delay 0.05 jitter=0.05",
            "duplicate 0.1",
            "gust 6",
        ):
            harness.vehicle.faults.begin(line)
        return [(at, data) for at, data in fly(harness, link, 2.0) if data[7:10] != b"\x02\0\0"]

    one, again, other = flight(3), flight(3), flight(4)
    assert len(one) > 500
    # SYSTEM_TIME and the remote identification carry the world's time
    assert [at for at, _ in one] == [at for at, _ in again]
    assert sum(a == b for a, b in zip(one, again, strict=True)) > 0.95 * len(one)
    assert [at for at, _ in one] != [at for at, _ in other]


@pytest.mark.streams("everything")
def test_lost_link_drops_both_directions(harness: SimHarness) -> None:
    link = LockstepLink(harness.vehicle, "onboard")
    assert fly(harness, link, 0.5)
    harness.vehicle.faults.begin("link_loss link=onboard for=1")
    link.send(dialect.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0))
    assert not fly(harness, link, 0.99)
    kinds = {message.get_type() for message in decoded(fly(harness, link, 0.5))}
    assert "ATTITUDE" in kinds
    assert "AUTOPILOT_VERSION" not in kinds


def test_delay_applies_to_both_directions(harness: SimHarness) -> None:
    link = LockstepLink(harness.vehicle, "onboard")
    harness.vehicle.faults.begin("link_delay 0.3")
    link.send(dialect.MAVLink_timesync_message(0, 77))
    for at_s, data in fly(harness, link, 1.0):
        for message in parser().parse_buffer(data) or []:
            if message.get_type() == "TIMESYNC" and message.tc1:
                assert message.ts1 == 77
                assert at_s == pytest.approx(0.6, abs=0.02)
                return
    raise AssertionError("no answer")


def test_fault_on_one_direction_of_one_link(harness: SimHarness) -> None:
    onboard, gcs = LockstepLink(harness.vehicle, "onboard"), LockstepLink(harness.vehicle, "gcs")
    harness.vehicle.faults.begin("link_loss link=onboard way=in")
    onboard.send(dialect.MAVLink_timesync_message(0, 77))
    gcs.send(dialect.MAVLink_timesync_message(0, 78), (245, 190))
    received_onboard, received_gcs = (
        decoded(fly(harness, onboard, 0.5)),
        decoded([(0.0, d) for d in gcs.receive()]),
    )
    assert received_onboard
    assert not [m for m in received_onboard if m.get_type() == "TIMESYNC" and m.ts1 == 77]
    assert [m for m in received_gcs if m.get_type() == "TIMESYNC" and m.ts1 == 78]


@pytest.mark.parametrize(
    ("text", "name", "values", "at_s", "duration_s"),
    [
        ("link_delay 0.2", "link_delay", {"seconds": 0.2, "link": "all"}, None, None),
        ("at=20 motor_failure 2", "motor_failure", {"motor": 2}, 20.0, None),
        ("for=5 packet_loss 0.3 link=gcs way=out", "packet_loss", {"share": 0.3, "way": "out"}, None, 5.0),
        ("packet_loss share=0.3", "packet_loss", {"share": 0.3}, None, None),
        ("battery Low", "battery", {"remaining": "low"}, None, None),
        ("battery 0.4", "battery", {"remaining": 0.4}, None, None),
        ("ekf_reset 1 2 yaw=30", "ekf_reset", {"north": 1.0, "east": 2.0, "yaw": 30.0}, None, None),
        ("refuse_mode offboard count=2", "refuse_mode", {"mode": "OFFBOARD", "count": "2"}, None, None),
        ("stall for=2 at=1", "stall", {"pace": 0.0}, 1.0, 2.0),
    ],
)
def test_words_in_any_order(
    text: str, name: str, values: dict[str, object], at_s: float | None, duration_s: float | None
) -> None:
    fault = parse_fault(text, KINDS)
    assert fault.kind.name == name
    assert values.items() <= dict(fault.values).items()
    assert (fault.at_s, fault.duration_s) == (at_s, duration_s)


@pytest.mark.parametrize("text", ["", "at=3"])
def test_text_without_a_fault_is_refused_with_where_they_are(text: str) -> None:
    with pytest.raises(FaultError) as error:
        parse_fault(text, KINDS)
    assert str(error.value).startswith(f"'{text}' ")
    assert f"`help` lists all {len(KINDS)}" in str(error.value)
    assert "\n" not in str(error.value)


@given(
    st.text(max_size=80)
    | st.lists(st.sampled_from([*KINDS, "at=1", "for=2", "0.5", "x", "link=all"])).map(" ".join)
)
def test_any_text_is_a_fault_or_an_error(text: str) -> None:
    try:
        fault = parse_fault(text, KINDS)
    except FaultError:
        return
    again = parse_fault(str(fault), KINDS)
    assert again.values == fault.values
    assert again.duration_s == fault.duration_s


def test_every_kind_has_an_effect_and_a_summary() -> None:
    assert set(KINDS) == set(EFFECTS)
    for kind in KINDS.values():
        assert kind.summary
        assert kind.usage.startswith(kind.name)


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def command() -> Callable[[str], Outcome]:
    vehicle = Vehicle()
    vehicle.add_link("onboard")
    return vehicle.faults.command


def test_lines_executed_when_complete(command: Callable[[str], Outcome], lines: list[str]) -> None:
    reading, writing = os.pipe()
    console = FaultConsole(reading, command, lines.append)
    console.poll()  # nothing typed: nothing waits
    os.write(writing, b"link_del")
    console.poll()
    assert lines == []
    os.write(writing, b"ay 0.2\n\n# a remark\nwind\nlist\n")
    console.poll()
    assert lines[0] == "fault 1 link_delay 0.2"
    assert lines[1].startswith("not done: ")
    assert "wind needs" in lines[1]
    assert lines[2].startswith("1 link_delay 0.2: since")
    os.write(writing, b"end all")
    os.close(writing)
    console.poll()
    console.poll()
    assert lines[3] == "ended 1"
    console.poll()  # the end was reached: nothing more happens
    assert len(lines) == 4
    console.close()
    os.close(reading)


def test_file_is_read_completely(command: Callable[[str], Outcome], lines: list[str], tmp_path: Path) -> None:
    path = tmp_path / "faults"
    path.write_text("link_loss for=3\nstall at=9")
    descriptor = os.open(path, os.O_RDONLY)
    console = FaultConsole(descriptor, command, lines.append)
    for _ in range(3):
        console.poll()
    assert lines == ["fault 1 link_loss for=3", "fault 2 stall at 9 s"]
    console.close()
    os.close(descriptor)


def test_terminal_is_read_and_may_close(command: Callable[[str], Outcome], lines: list[str]) -> None:
    controller, terminal = pty.openpty()
    tty.setraw(terminal)
    console = FaultConsole(terminal, command, lines.append)
    os.write(controller, b"gust 5\n")
    assert select.select([terminal], [], [], 10.0)[0]  # the terminal hands it on in its own time
    console.poll()
    assert lines == ["fault 1 gust 5"]
    os.close(controller)
    console.poll()
    console.poll()
    console.close()
    os.close(terminal)


def test_binary_and_endless_lines_are_harmless(command: Callable[[str], Outcome], lines: list[str]) -> None:
    reading, writing = os.pipe()
    console = FaultConsole(reading, command, lines.append)
    os.write(writing, b"\xff\xfe\x00\n")
    console.poll()
    assert lines[0].startswith("not done: ")
    for _ in range(8):
        os.write(writing, b"x" * 4096)
        console.poll()
    os.write(writing, b"\nlist\n")
    console.poll()
    assert lines[-1] == "no faults"
    console.close()
    os.close(reading)
    os.close(writing)
