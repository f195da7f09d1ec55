"""Autopilots are found by listening, and nothing of another program is opened."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.doctor.facts import Facts, User
from companion.doctor.listening import Received, Sender, listen
from companion.settings import Settings
from companion.setup import autopilots as search
from companion.setup.autopilots import BAUDS, Autopilot, find_autopilots
from companion.setup.tried import Tried
from companion.vehicle.link_url import LinkScheme, LinkUrl, parse_link_url
from tests.companion.doctor.computer import Computer
from tests.companion.service_process import heartbeats
from tests.companion.setup.serial_wire import Wires, as_read_at, telemetry

PX4 = Sender(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 2, False, frozenset({"127.0.0.1:9"}))


@pytest.fixture
def computer(tmp_path: Path) -> Computer:
    return Computer(tmp_path)


def found(
    computer: Computer, wires: Wires, settings: dict[str, Any] | None = None, **options: Any
) -> tuple[list[Autopilot], dict[str, Tried]]:
    """Return the autopilots, and the results by place."""
    tried: dict[str, Tried] = {}
    facts = Facts(Settings.from_json(settings or {}), computer.machine())
    autopilots = find_autopilots(
        facts, lambda each: tried.update({each.where: each}), listen=wires.listen, **options
    )
    return autopilots, tried


def receiving(url: str, *senders: tuple[int, Sender]) -> dict[str, Received]:
    return {url: Received(2.0, {(system, 1): sender for system, sender in senders}, 9)}


@pytest.mark.parametrize("baud", [921600, 115200, 57600, 230400])
def test_baud_rate_is_found_among_the_noise_of_others(computer: Computer, baud: int) -> None:
    line = computer.root / "dev" / "ttyAMA0"
    wires = Wires({line: (baud, telemetry())})
    (autopilot,), tried = found(computer, wires)
    assert autopilot.url == LinkUrl(LinkScheme.SERIAL, ("/dev/ttyAMA0", baud))
    assert autopilot.address == (1, 1)
    assert autopilot.is_flown
    assert str(baud) in tried[str(line)].found
    rates = [url.address[1] for url in wires.opened if url.scheme is LinkScheme.SERIAL]
    assert rates == list(BAUDS[: BAUDS.index(baud) + 1])


@pytest.mark.parametrize("read", [each for each in BAUDS if each != 57600])
def test_wrong_baud_rate_reads_noise_and_no_heartbeat(read: int) -> None:
    noise = as_read_at(telemetry(), 57600, read)
    assert noise != telemetry()
    assert (
        not Wires({Path("/x"): (57600, telemetry())}).listen(parse_link_url(f"serial:///x:{read}"), 1).senders
    )


def test_line_of_another_device_is_named_as_noise(computer: Computer) -> None:
    line = computer.root / "dev" / "ttyAMA0"
    autopilots, tried = found(computer, Wires({line: (9600, b"$GPGGA,123519,4807.038,N,01131.000,E" * 20)}))
    assert autopilots == []
    assert "not MAVLink" in tried[str(line)].found
    assert tried[str(line)].advice


def test_only_rates_with_bytes_are_named_as_noise(computer: Computer) -> None:
    line = computer.root / "dev" / "ttyAMA0"
    facts, tried = Facts(Settings(), computer.machine()), dict[str, Tried]()

    def listen(url: LinkUrl, *_: object) -> Received:
        return Received(1.0, skipped_bytes=9 if url.address[1] == 57600 else 0)

    find_autopilots(facts, lambda each: tried.update({each.where: each}), listen=listen)
    assert [str(baud) for baud in BAUDS if str(baud) in tried[str(line)].found] == ["57600"]


def test_silent_line_names_the_rates_that_were_tried(computer: Computer) -> None:
    _, tried = found(computer, Wires())
    text = tried[str(computer.root / "dev" / "ttyAMA0")].found
    assert text.startswith("silent")
    assert all(str(baud) in text for baud in BAUDS)


def test_usb_line_is_listened_to_once_by_its_stable_name(computer: Computer) -> None:
    device = computer.device("ttyACM0")
    (folder := computer.root / "dev" / "serial" / "by-id").mkdir(parents=True)
    (link := folder / "usb-Auterion_PX4_FMU-if00").symlink_to(device)
    wires = Wires({link: (57600, telemetry())})
    wires_usb = Wires({link: (115200, telemetry())})  # USB has no rate: what is written is read
    assert found(computer, wires)[0] == []
    (autopilot,), _ = found(computer, wires_usb)
    assert autopilot.url.address[0] == "/dev/serial/by-id/usb-Auterion_PX4_FMU-if00"
    assert sum(url.address[0] == str(link) for url in wires_usb.opened) == 1


def hold(computer: Computer) -> None:
    computer.program(77, "minicom", opened=[computer.root / "dev" / "ttyAMA0"])


def getty(computer: Computer) -> None:
    computer.program(300, "/sbin/agetty -o x 115200 ttyAMA0", cgroup="/serial-getty@ttyAMA0.service")


def router(computer: Computer) -> None:
    computer.program(400, "/usr/bin/mavlink-routerd")


def console(computer: Computer) -> None:
    computer.write("sys/class/tty/console/active", "tty0 ttyAMA0")


def forbid(computer: Computer) -> None:
    computer.user = User("ann", 54321, frozenset())


@pytest.mark.parametrize("change", [hold, getty, router, console, forbid])
def test_line_of_another_program_is_not_opened(computer: Computer, change: Any) -> None:
    change(computer)
    line = computer.root / "dev" / "ttyAMA0"
    wires = Wires({line: (921600, telemetry())})
    autopilots, tried = found(computer, wires)
    assert autopilots == []
    assert all(url.scheme is not LinkScheme.SERIAL for url in wires.opened)
    assert tried[str(line)].found.startswith("not opened")
    assert tried[str(line)].advice


def test_taken_port_is_not_opened(computer: Computer) -> None:
    computer.socket("udp", "127.0.0.1", 14540, inode=5)
    wires = Wires()
    _, tried = found(computer, wires)
    assert "UDP port 14540" in tried
    assert "taken" in tried["UDP port 14540"].found
    assert [url.address[1] for url in wires.opened if url.scheme is LinkScheme.UDP_IN] == [14550]


def test_vehicle_received_at_two_ports_is_one(computer: Computer) -> None:
    network = {
        **receiving("udpin://0.0.0.0:14540", (1, PX4)),
        **receiving("udpin://0.0.0.0:14550", (1, PX4)),
    }
    autopilots, _ = found(computer, Wires(network=network))
    assert [str(each.url) for each in autopilots] == ["udpin://127.0.0.1:14540"]


def test_vehicle_on_the_network_needs_every_interface(computer: Computer) -> None:
    far = Sender(2, 12, 2, False, frozenset({"192.0.2.7:14580"}))
    autopilots, _ = found(computer, Wires(network=receiving("udpin://0.0.0.0:14540", (1, far))))
    assert [str(each.url) for each in autopilots] == ["udpin://0.0.0.0:14540"]


def test_surest_is_flown_and_on_a_serial_line(computer: Computer) -> None:
    line = computer.root / "dev" / "ttyAMA0"
    usb = computer.device("ttyACM0")
    network = receiving("udpin://0.0.0.0:14540", (3, PX4))
    plane = telemetry(mav_type=mavlink.MAV_TYPE_FIXED_WING)
    wires = Wires({line: (57600, telemetry()), usb: (115200, plane)}, network)
    autopilots, _ = found(computer, wires)
    assert [each.url.scheme for each in autopilots] == ["serial", "udpin", "serial"]
    assert [each.is_flown for each in autopilots] == [True, True, False]


def test_present_link_comes_first_and_keeps_its_text(computer: Computer) -> None:
    line = computer.root / "dev" / "ttyAMA0"
    present = parse_link_url("udpin://0.0.0.0:14600")
    network = receiving("udpin://0.0.0.0:14600", (1, PX4))
    wires = Wires({line: (57600, telemetry())}, network)
    autopilots, _ = found(computer, wires, present=present)
    assert autopilots[0].url == present
    assert len(autopilots) == 2


def test_present_baud_rate_is_tried_first(computer: Computer) -> None:
    line = computer.root / "dev" / "ttyAMA0"
    wires = Wires({line: (57600, telemetry())})
    (autopilot,), _ = found(computer, wires, present=parse_link_url("serial:///dev/ttyAMA0:57600"))
    rates = [url.address[1] for url in wires.opened if url.scheme is LinkScheme.SERIAL]
    assert rates == [57600]
    assert autopilot.url.address == ("/dev/ttyAMA0", 57600)


def test_tcp_is_tried_only_where_something_listens(computer: Computer) -> None:
    wires = Wires(network=receiving("tcp://127.0.0.1:5760", (1, PX4)))
    assert found(computer, wires)[0] == []
    assert all(url.scheme is not LinkScheme.TCP for url in wires.opened)
    computer.socket("tcp", "127.0.0.1", 5760, inode=6)
    assert [str(each.url) for each in found(computer, wires)[0]] == ["tcp://127.0.0.1:5760"]


def test_ground_station_alone_is_no_autopilot(computer: Computer) -> None:
    station = Sender(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 2, False)
    autopilots, tried = found(computer, Wires(network=receiving("udpin://0.0.0.0:14550", (255, station))))
    assert autopilots == []
    assert "255/1" in tried["UDP port 14550"].found


def test_search_that_hangs_is_left(computer: Computer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "MOST_S", 0.3)
    with socket.socketpair()[0] as waiting:  # nobody writes to it

        def hang(*_: Any) -> Received:
            waiting.recv(1)
            return Received()

        monkeypatch.setattr(Wires, "listen", hang)
        autopilots, tried = found(computer, Wires())
    assert autopilots == []
    assert set(tried) == {str(computer.root / "dev" / "ttyAMA0"), "UDP port 14540", "UDP port 14550"}


@pytest.fixture
def quiet_port() -> Iterator[int]:
    with heartbeats() as port:
        yield port


@pytest.mark.realtime
def test_listening_ends_when_enough_was_received(quiet_port: int) -> None:
    url = parse_link_url(f"udpin://127.0.0.1:{quiet_port}")
    received = listen(url, 60.0, lambda so_far: bool(so_far.senders))
    assert received.seconds < 30.0
    assert (1, 1) in received.senders
