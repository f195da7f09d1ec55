"""Any message of a client: the vehicle continues, and its messages can be packed."""

import struct
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.services.microservices import HANDLERS
from mavlink_sim.wire.messages import dialect, parser
from tests.mavlink_sim.conftest import SimHarness

HANDLED = {m.id: m for m in dialect.mavlink_map.values() if m.msgname in HANDLERS}
OTHERS = {m.id: m for m in dialect.mavlink_map.values() if m.msgname not in HANDLERS}


def packet(identifier: int, payload: bytes, source: tuple[int, int]) -> bytes:
    """A MAVLink 2 frame with any payload and a valid checksum."""
    body = struct.pack("<BBBBBBHB", len(payload), 0, 0, 0, *source, identifier & 0xFFFF, identifier >> 16)
    body += payload
    crc = dialect.x25crc(body)
    crc.accumulate(bytes([dialect.mavlink_map[identifier].crc_extra]))
    return b"\xfd" + body + struct.pack("<H", crc.crc)


@st.composite
def packets(draw: st.DrawFn, kinds: dict[int, Any]) -> bytes:
    identifier = draw(st.sampled_from(sorted(kinds)))
    size = kinds[identifier].unpacker.size
    payload = bytearray(draw(st.binary(min_size=size, max_size=size)))
    if draw(st.booleans()):  # addressed to the autopilot, where the message has an address
        offsets = _offsets(kinds[identifier])
        for field in ("target_system", "target_component"):
            if field in offsets:
                payload[offsets[field]] = 1
    return packet(identifier, bytes(payload), draw(st.sampled_from([(1, 191), (245, 190), (0, 0)])))


def _offsets(kind: Any) -> dict[str, int]:
    """The position of each field in the payload."""
    found, offset = {}, 0
    for name, code, length in zip(
        kind.ordered_fieldnames, kind.native_format.decode()[1:], kind.lengths, strict=True
    ):
        found[name] = offset
        offset += struct.calcsize(f"<{code}") * max(length, 1)
    return found


def fly_through(harness: SimHarness, datagrams: list[bytes]) -> None:
    reader = parser()
    for datagram in datagrams:
        for message in reader.parse_buffer(datagram) or []:
            harness.vehicle.handle("onboard", message)
        harness.fly(0.05)
    harness.fly(0.5)
    codec = parser()
    for link in ("onboard", "gcs"):
        for _, item in harness.inbox[link]:
            assert item.pack(codec)


@settings(max_examples=25, deadline=None)
@given(st.lists(packets(HANDLED), min_size=1, max_size=12))
def test_messages_it_handles(datagrams: list[bytes]) -> None:
    harness = SimHarness(["everything"], ready_after_s=0.0)
    harness.command(400, 1)
    fly_through(harness, datagrams)


@settings(max_examples=10, deadline=None)
@given(st.lists(packets(OTHERS), min_size=1, max_size=12))
def test_messages_it_does_not_handle(datagrams: list[bytes]) -> None:
    harness = SimHarness(["everything"], ready_after_s=0.0)
    harness.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), "gcs", (245, 190))
    fly_through(harness, datagrams)


finite = st.floats(-1e30, 1e30)


PARAMETERS = [
    "MPC_XY_P",
    "MPC_XY_VEL_P_ACC",
    "MPC_Z_VEL_P_ACC",
    "MPC_XY_VEL_I_ACC",
    "MPC_ACC_HOR",
    "MPC_XY_ERR_MAX",
    "MPC_XY_CRUISE",
    "MPC_TILTMAX_AIR",
    "MPC_TKO_RAMP_T",
    "MPC_LAND_SPEED",
    "MPC_Z_VEL_MAX_UP",
    "COM_OF_LOSS_T",
    "COM_SPOOLUP_TIME",
    "RTL_RETURN_ALT",
    "RTL_DESCEND_ALT",
    "RTL_TIME_FACTOR",
    "SIM_BAT_DRAIN",
    "SIM_BAT_MIN_PCT",
    "SIH_WIND_N",
]


@settings(max_examples=10, deadline=None)
@given(st.dictionaries(st.sampled_from(PARAMETERS), finite, min_size=1, max_size=5))
def test_parameters_out_of_every_range(values: dict[str, float]) -> None:
    harness = SimHarness(["everything"], ready_after_s=0.0)
    for name, value in values.items():
        harness.vehicle.parameters.set(name, value)
    harness.fly(0.1)
    harness.command(400, 1)
    harness.command(22, *[float("nan")] * 7)
    harness.fly(4.0)
    harness.command(20)
    fly_through(harness, [])
