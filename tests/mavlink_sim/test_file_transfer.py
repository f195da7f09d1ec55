"""MAVLink FTP: the protocol in lockstep, and foreign clients over UDP."""

import asyncio
import errno
import json
import lzma
import os
import struct
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsdk.asyncio.plugins.component_metadata import ComponentMetadataAsync
from mavsdk.asyncio.plugins.ftp import FtpAsync, FtpError
from mavsdk.plugins.component_metadata import MetadataType
from pymavlink import mavftp, mavutil

from mavlink_sim.px4.parameters import Parameters, default_parameters
from mavlink_sim.services.file_system import FileSystem, resolve
from mavlink_sim.services.file_transfer import DATA_BYTES, WRITES, Failure, Opcode, Packet, Server
from mavlink_sim.services.vehicle_files import bson, event_metadata
from mavlink_sim.testing import RunningSimulator, running_simulator
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness
from tests.mavlink_sim.mavsdk_client import mavsdk_client

pytestmark = pytest.mark.realtime


class Client:
    """A client in lockstep: one request, and the packets that came back within 20 ms."""

    def __init__(self, harness: SimHarness) -> None:
        self.harness = harness
        self.sequence = 0

    def ask(
        self, opcode: int, data: bytes = b"", offset: int = 0, session: int = 0, size: int = -1
    ) -> list[Packet]:
        self.sequence += 2
        return self.repeat(opcode, data, offset, session, size)

    def repeat(
        self, opcode: int, data: bytes = b"", offset: int = 0, session: int = 0, size: int = -1
    ) -> list[Packet]:
        """Repeat it with the same number, as after a lost answer."""
        payload = struct.pack(
            "<HBBBBBBI", self.sequence, session, opcode, len(data) if size < 0 else size, 0, 0, 0, offset
        )
        self.harness.forget()
        self.harness.send(
            dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, (payload + data).ljust(251, b"\0"))
        )
        self.harness.fly(0.02)
        messages = self.harness.received("FILE_TRANSFER_PROTOCOL")
        assert all((message.target_system, message.target_component) == (1, 191) for message in messages)
        return [Packet.unpack(bytes(message.payload)) for message in messages]

    def ack(self, opcode: int, *arguments: Any, **options: Any) -> Packet:
        (answer,) = self.ask(opcode, *arguments, **options)
        assert answer.opcode == Opcode.ACK, answer
        assert (answer.requested, answer.sequence) == (opcode, self.sequence + 1)
        return answer

    def nak(self, opcode: int, *arguments: Any, **options: Any) -> tuple[int, ...]:
        (answer,) = self.ask(opcode, *arguments, **options)
        assert (answer.opcode, answer.requested) == (Opcode.NAK, opcode)
        return tuple(answer.data)

    def list(self, path: bytes) -> list[bytes]:
        return self.ack(Opcode.LIST_DIRECTORY, path).data.rstrip(b"\0").split(b"\0")


@pytest.fixture
def client(harness: SimHarness) -> Client:
    harness.fly(0.1)
    return Client(harness)


def test_the_root_lists_what_px4_has_there(client: Client) -> None:
    entries = client.list(b"/")
    assert entries[:2] == [b"S", b"S"]  # "." and ".."
    size = len(bson(client.harness.vehicle.parameters.customised()))
    assert entries[2:] == [
        b"Detc",
        b"Dlog",
        b"Fparameters.bson\t%d" % size,
        b"Fparameters_backup.bson\t%d" % size,
    ]


def test_storage_card_path_is_the_root(client: Client) -> None:
    client.harness.vehicle.files.provide("note.txt", lambda: b"hello")
    for path in (b"", b"/fs/microsd"):
        assert b"Fnote.txt\t5" in client.list(path)


def test_long_list_is_split_by_offset(client: Client) -> None:
    names = [f"file-number-{number:03d}" for number in range(30)]
    for name in names:
        client.harness.vehicle.files.provide(f"many/{name}", lambda: b"")
    found: list[bytes] = []
    while True:
        (answer,) = client.ask(Opcode.LIST_DIRECTORY, b"many", len(found))
        if answer.opcode == Opcode.NAK:
            assert answer.data == bytes([Failure.END_OF_FILE])
            break
        found += answer.data.rstrip(b"\0").split(b"\0")
    assert found == [b"S", b"S"] + [f"F{name}\t0".encode() for name in names]


def test_a_file_is_read_and_burst(client: Client) -> None:
    content = os.urandom(5000)
    client.harness.vehicle.files.provide("log/flight.ulg", lambda: content)
    assert client.ack(Opcode.OPEN_FILE_RO, b"log/flight.ulg").data == struct.pack("<I", 5000)
    assert client.ack(Opcode.READ_FILE, b"", 4900, size=239).data == content[4900:]
    assert client.nak(Opcode.READ_FILE, b"", 5000, size=239) == (Failure.END_OF_FILE,)
    packets = client.ask(Opcode.BURST_READ_FILE, b"", 239, size=239)
    assert [packet.sequence for packet in packets] == list(
        range(client.sequence + 1, client.sequence + 1 + len(packets))
    )
    assert b"".join(packet.data for packet in packets[:-1]) == content[239:]
    assert (packets[-1].opcode, packets[-1].data) == (Opcode.NAK, bytes([Failure.END_OF_FILE]))
    client.ack(Opcode.TERMINATE_SESSION)


def test_burst_pauses_after_35_kb_and_continues_at_offset(client: Client) -> None:
    content = os.urandom(100_000)
    client.harness.vehicle.files.provide("big", lambda: content)
    client.ack(Opcode.OPEN_FILE_RO, b"big")
    got = b""
    rounds = 0
    while len(got) < len(content):
        packets = client.ask(Opcode.BURST_READ_FILE, b"", len(got), size=239)
        client.harness.fly(0.4)
        packets = [
            Packet.unpack(bytes(message.payload))
            for message in client.harness.received("FILE_TRANSFER_PROTOCOL")
        ]
        assert [packet.burst_complete for packet in packets[:-1]] == [False] * (len(packets) - 1)
        assert packets[-1].burst_complete or packets[-1].opcode == Opcode.NAK
        got += b"".join(packet.data for packet in packets if packet.opcode == Opcode.ACK)
        rounds += 1
    assert got == content
    assert rounds == 3


def test_one_session_per_link_closes_after_10_s(client: Client) -> None:
    client.ack(Opcode.OPEN_FILE_RO, b"parameters.bson")
    assert client.nak(Opcode.OPEN_FILE_RO, b"parameters.bson") == (Failure.NO_SESSIONS_AVAILABLE,)
    client.harness.fly(9.0)
    assert client.nak(Opcode.OPEN_FILE_RO, b"x") == (Failure.NO_SESSIONS_AVAILABLE,)
    client.harness.fly(10.1)
    assert client.nak(Opcode.READ_FILE, size=4) == (Failure.INVALID_SESSION,)
    client.ack(Opcode.OPEN_FILE_RO, b"parameters.bson")
    client.ack(Opcode.RESET_SESSIONS)
    client.ack(Opcode.OPEN_FILE_RO, b"parameters.bson")


def test_repeated_request_executed_once(client: Client) -> None:
    client.ack(Opcode.OPEN_FILE_RO, b"parameters.bson")
    (again,) = client.repeat(Opcode.OPEN_FILE_RO, b"parameters.bson")
    assert again.opcode == Opcode.ACK
    assert client.nak(Opcode.OPEN_FILE_RO, b"parameters.bson") == (Failure.NO_SESSIONS_AVAILABLE,)


@pytest.mark.parametrize(
    ("opcode", "data", "failure"),
    [
        (Opcode.LIST_DIRECTORY, b"nowhere", (Failure.FILE_NOT_FOUND,)),
        (Opcode.OPEN_FILE_RO, b"nowhere", (Failure.FILE_NOT_FOUND,)),
        (Opcode.OPEN_FILE_RO, b"@PARAM/param.pck", (Failure.FILE_NOT_FOUND,)),  # ArduPilot's; PX4 has none
        (Opcode.OPEN_FILE_RO, b"etc", (Failure.FAIL_ERRNO, errno.EISDIR)),
        (Opcode.OPEN_FILE_RO, b"parameters.bson/x", (Failure.FAIL_ERRNO, errno.ENOTDIR)),
        (Opcode.LIST_DIRECTORY, b"parameters.bson", (Failure.FAIL_ERRNO, errno.ENOTDIR)),
        (Opcode.CALC_FILE_CRC32, b"nowhere", (Failure.FILE_NOT_FOUND,)),
        (Opcode.READ_FILE, b"", (Failure.INVALID_SESSION,)),
        (Opcode.BURST_READ_FILE, b"", (Failure.INVALID_SESSION,)),
        (Opcode.TERMINATE_SESSION, b"", (Failure.INVALID_SESSION,)),
        (77, b"", (Failure.UNKNOWN_COMMAND,)),
        (Opcode.ACK, b"", (Failure.UNKNOWN_COMMAND,)),
        *((opcode, b"log/x", (Failure.FILE_PROTECTED,)) for opcode in sorted(WRITES)),
    ],
)
def test_failures_have_px4s_codes(client: Client, opcode: int, data: bytes, failure: tuple[int, ...]) -> None:
    assert client.nak(opcode, data) == failure


def test_a_size_beyond_the_payload_is_refused(client: Client) -> None:
    assert client.nak(Opcode.OPEN_FILE_RO, b"x", size=240) == (Failure.INVALID_DATA_SIZE,)


def test_checksum_of_a_file_is_px4s_variant(client: Client) -> None:
    client.harness.vehicle.files.provide("one", lambda: b"123456789")
    # the check value of this CRC-32 variant (no inversions), as PX4 computes it
    assert client.ack(Opcode.CALC_FILE_CRC32, b"one").data == struct.pack("<I", 0x2DFD2D88)


def test_the_host_cannot_be_reached(client: Client) -> None:
    here = Path(__file__).resolve()
    for path in (str(here), "../../../../../../etc/passwd", "/etc/passwd", "..\\..", f"etc/../..{here}"):
        assert client.nak(Opcode.OPEN_FILE_RO, path.encode()) == (Failure.FILE_NOT_FOUND,)


@given(st.lists(st.sampled_from(["a", "..", ".", "", "fs", "microsd", "etc"]), max_size=12))
def test_no_path_leads_above_the_root(names: list[str]) -> None:
    assert ".." not in resolve("/".join(names))


@given(
    st.lists(
        st.tuples(
            st.one_of(st.sampled_from(list(Opcode)), st.integers(0, 255)),
            st.binary(max_size=DATA_BYTES),
            st.one_of(st.integers(0, 300), st.integers(0, 2**32 - 1)),
            st.integers(0, 255),
        ),
        max_size=20,
    )
)
def test_any_payload_is_answered(requests: list[tuple[int, bytes, int, int]]) -> None:
    files = FileSystem()
    files.provide("etc/file", lambda: b"content")
    server = Server(files)
    for number, (opcode, data, offset, size) in enumerate(requests):
        header = struct.pack("<HBBBBBBI", number * 2, 0, opcode, size, 0, 0, 0, offset)
        reply = server.answer((header + data).ljust(251, b"\0"), (1, 191), number * 0.1)
        assert reply is None or len(reply) == 251
        assert all(len(payload) == 251 for _, payload in server.burst(number * 0.1))


def test_a_file_is_generated_at_each_read() -> None:
    files = FileSystem()
    contents = iter([b"one", b"two"])
    files.provide("etc/now", lambda: next(contents))
    assert [files.read("etc/now"), files.read("/etc/now")] == [b"one", b"two"]


# ---- what is in the files


def test_parameter_file_holds_what_differs_from_defaults_as_bson() -> None:
    parameters = Parameters({"COM_OF_LOSS_T": 0.5, "NAV_RCL_ACT": 3})
    content = bson(parameters.customised())
    assert content == (
        struct.pack("<i", len(content))
        + b"\x01COM_OF_LOSS_T\0" + struct.pack("<d", 0.5)
        + b"\x10NAV_RCL_ACT\0" + struct.pack("<i", 3)
        + b"\0"
    )  # fmt: skip


def test_the_metadata_is_found_through_component_metadata(harness: SimHarness) -> None:
    harness.fly(0.1)
    assert harness.command(512, 397) == [0]
    (message,) = harness.received("COMPONENT_METADATA")
    assert message.uri.startswith("mftp://")

    def content(uri: str) -> bytes:
        # As in every release.
        assert uri.startswith("mftp://etc/")
        return lzma.decompress(bytes(harness.vehicle.files.read(uri.removeprefix("mftp://"))))

    def crc(data: bytes) -> int:
        return zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF

    general = content(message.uri)
    assert message.file_crc == crc(general)
    types = json.loads(general)["metadataTypes"]
    assert [entry["type"] for entry in types] == [1, 4]
    for entry in types:
        assert entry["fileCrc"] == crc(content(entry["uri"]))
    listed = json.loads(content(types[0]["uri"]))["parameters"]
    assert [entry["name"] for entry in listed] == [parameter.name for parameter in default_parameters()]


# ---- other clients


@pytest.mark.parametrize(
    ("release", "joins"), [("1.14", False), ("1.15", False), ("1.16", True), ("1.17", True)]
)
def test_path_without_a_slash_is_joined_since_v1_16(release: str, joins: bool) -> None:
    client = Client(SimHarness(px4=release))
    assert client.ack(Opcode.OPEN_FILE_RO, b"/etc/extras/all_events.json.xz")
    client.ack(Opcode.RESET_SESSIONS)
    if joins:
        assert client.ack(Opcode.OPEN_FILE_RO, b"etc/extras/all_events.json.xz")
    else:
        assert client.nak(Opcode.OPEN_FILE_RO, b"etc/extras/all_events.json.xz") == (Failure.FILE_NOT_FOUND,)


@pytest.fixture(scope="module")
def simulator() -> Iterator[RunningSimulator]:
    with running_simulator() as running:
        yield running


async def collect(transfer: Any) -> list[Any]:
    return [progress async for progress in transfer]


async def test_mavsdk_lists_loads_and_compares(simulator: RunningSimulator, tmp_path: Path) -> None:
    folder, name = "/etc/extras", "all_events.json.xz"
    async with mavsdk_client(f"udpin://127.0.0.1:{simulator.gcs_port}") as system:
        ftp = system.plugin(FtpAsync)
        root = await ftp.list_directory("/")
        names = {entry.name for entry in root.entries}
        assert names == {"etc", "log", "parameters.bson", "parameters_backup.bson"}
        assert (await ftp.list_directory("/log")).entries == []
        (size,) = (e.size_bytes for e in (await ftp.list_directory(folder)).entries if e.name == name)
        loaded = tmp_path / name
        for burst in (False, True):
            await collect(ftp.download(f"{folder}/{name}", str(tmp_path), burst))
            assert loaded.stat().st_size == size
            assert lzma.decompress(loaded.read_bytes()) == event_metadata()
            assert await ftp.are_files_identical(str(loaded), f"{folder}/{name}")
            loaded.unlink()
        with pytest.raises(FtpError):
            await collect(ftp.download("/nowhere", str(tmp_path), False))
        with pytest.raises(FtpError, match="PROTECTED"):
            await ftp.create_directory("/log/mine")


async def test_mavsdk_finds_the_metadata(simulator: RunningSimulator) -> None:
    async with mavsdk_client(f"udpin://127.0.0.1:{simulator.gcs_port}") as system:
        metadata = system.plugin(ComponentMetadataAsync)
        updates = metadata.subscribe_metadata_available()
        update = asyncio.ensure_future(anext(updates))
        await asyncio.sleep(0)  # lets it subscribe
        await metadata.request_autopilot_component()
        while (await update).type != MetadataType.ALL_COMPLETED:
            update = asyncio.ensure_future(anext(updates))
        await updates.aclose()
        found = await metadata.get_metadata(1, MetadataType.PARAMETER)
        names = [entry["name"] for entry in json.loads(found.json_metadata)["parameters"]]
        assert names == [parameter.name for parameter in default_parameters()]
        events = await metadata.get_metadata(1, MetadataType.EVENTS)
        assert "components" in json.loads(events.json_metadata)


def test_pymavlinks_own_client_loads_a_file(simulator: RunningSimulator, tmp_path: Path) -> None:
    target = tmp_path / "target"
    link = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{simulator.onboard_port}", source_system=1, source_component=191
    )
    try:
        link.wait_heartbeat(timeout=20)
        link.recv_match = partial(link.recv_match, blocking=True)  # MAVFTP calls it in a loop without a wait
        ftp = mavftp.MAVFTP(link, 1, 1)
        ftp.cmd_list(["/"])
        ftp.process_ftp_reply("ListDirectory", timeout=10)
        assert ftp.list_result
        assert ftp.cmd_get(["etc/extras/all_events.json.xz", str(target)]).error_code == 0
        assert ftp.process_ftp_reply("OpenFileRO", timeout=30).error_code == 0
        assert lzma.decompress(target.read_bytes()) == event_metadata()
    finally:
        link.close()
