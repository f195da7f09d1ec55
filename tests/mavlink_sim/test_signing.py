"""MAVLink 2 signing by PX4's rules, with pymavlink as the client."""

import hashlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil

from mavlink_sim.testing import running_simulator
from mavlink_sim.wire.endpoint import UdpEndpoint
from mavlink_sim.wire.messages import Outgoing, component_metadata, dialect, parser
from mavlink_sim.wire.signing import ALWAYS, EXCEPT_USB, OPTIONAL, Signing, key_of, timestamp_now
from tests.mavlink_sim.conftest import SimHarness

pytestmark = pytest.mark.realtime

KEY = bytes(range(32))
OTHER_KEY = bytes(32 * [7])
START = 36_000_000_000_000  # a timestamp of 2026


def client(key: bytes | None = KEY, timestamp: int = START, link_id: int = 5) -> Any:
    """A pymavlink codec that signs."""
    codec = parser(245, 190)
    if key is not None:
        codec.signing.secret_key = key
        codec.signing.sign_outgoing = True
        codec.signing.timestamp = timestamp
        codec.signing.link_id = link_id
    return codec


def heartbeat(codec: Any) -> bytes:
    return bytes(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(codec))


def vehicle_signing(policy: int = ALWAYS, timestamp: int = START, **options: Any) -> Signing:
    signing = Signing(policy=lambda: policy, **options)
    signing.set_up(KEY, timestamp)
    return signing


def test_without_a_key_frames_pass_untouched() -> None:
    signing = Signing()
    frame = heartbeat(client(None))
    assert signing.signed(frame) == frame
    assert signing.accepts(frame)
    assert signing.accepts(heartbeat(client(OTHER_KEY)))
    assert not signing.has_key


def test_a_signed_frame_has_the_layout_of_the_specification() -> None:
    signing = Signing(link_id=3)
    signing.set_up(KEY, START)
    frame = signing.signed(heartbeat(client(None)))
    assert frame[2] == 1
    assert frame[-13] == 3
    assert int.from_bytes(frame[-12:-6], "little") == START + 1
    assert frame[-6:] == hashlib.sha256(KEY + frame[:-6]).digest()[:6]
    assert signing.signed(frame) == frame  # never twice


frames = st.one_of(
    st.builds(
        dialect.MAVLink_param_value_message,
        st.binary(min_size=16, max_size=16),
        st.floats(width=32, allow_nan=False),
        st.sampled_from([6, 9]),
        st.integers(0, 65535),
        st.integers(0, 65535),
    ),
    st.builds(
        dialect.MAVLink_file_transfer_protocol_message,
        st.just(0),
        st.integers(0, 255),
        st.integers(0, 255),
        st.binary(min_size=251, max_size=251),
    ),
)


@settings(max_examples=50)
@given(frames)
def test_pymavlink_accepts_signed_frames(message: Any) -> None:
    signing = vehicle_signing(timestamp=START)
    reader = client(timestamp=START)
    reader.signing.allow_unsigned_callback = None
    sender = parser(1, 1)
    (read,) = reader.parse_buffer(signing.signed(bytes(message.pack(sender))))
    assert read.get_type() == message.get_type()
    assert read.get_signed()
    assert reader.signing.badsig_count == 0


def test_a_message_outside_pymavlinks_dialects_is_signed_too() -> None:
    signing = vehicle_signing()
    frame = Outgoing(component_metadata(1, 2, "mftp://x"), 1, 1).pack(parser())
    crc = dialect.x25crc(signing.signed(frame)[1:-15])
    crc.accumulate([182])
    assert crc.crc.to_bytes(2, "little") == signing.signed(frame)[-15:-13]


def test_valid_signed_frame_accepted_once() -> None:
    signing = vehicle_signing()
    frame = heartbeat(client())
    assert signing.accepts(frame)
    assert not signing.accepts(frame)
    assert signing.refused == {"replayed": 1}


def test_an_older_frame_of_the_same_stream_is_a_replay() -> None:
    signing = vehicle_signing()
    codec = client()
    first, second = heartbeat(codec), heartbeat(codec)
    assert signing.accepts(second)
    assert not signing.accepts(first)


def test_a_new_stream_may_be_a_minute_old_and_no_more() -> None:
    signing = vehicle_signing()
    assert signing.accepts(heartbeat(client(timestamp=START - 5_999_999, link_id=1)))
    assert not signing.accepts(heartbeat(client(timestamp=START - 6_000_002, link_id=2)))
    assert signing.refused == {"old timestamp": 1}


def test_a_replay_on_another_link_of_the_vehicle_is_refused() -> None:
    streams: dict[tuple[int, int, int], int] = {}
    one, two = (vehicle_signing(streams=streams, link_id=number) for number in (0, 1))
    frame = heartbeat(client())
    assert one.accepts(frame)
    assert not two.accepts(frame)


def test_sixteen_streams_are_stored() -> None:
    signing = vehicle_signing()
    answers = [signing.accepts(heartbeat(client(link_id=number))) for number in range(17)]
    assert answers == [True] * 16 + [False]
    assert signing.refused == {"too many streams": 1}


def test_the_vehicles_time_follows_its_clients() -> None:
    signing = vehicle_signing(timestamp=START)
    assert signing.accepts(heartbeat(client(timestamp=START + 1_000_000)))
    frame = signing.signed(heartbeat(client(None)))
    assert int.from_bytes(frame[-12:-6], "little") > START + 1_000_000


@pytest.mark.parametrize(
    ("policy", "is_usb", "accepted"),
    [(OPTIONAL, False, True), (EXCEPT_USB, False, False), (EXCEPT_USB, True, True), (ALWAYS, True, False)],
)
def test_mav_sign_cfg_decides_about_unsigned_frames(policy: int, is_usb: bool, accepted: bool) -> None:
    signing = vehicle_signing(policy, is_usb=is_usb)
    assert signing.accepts(heartbeat(client(None))) is accepted
    one = client(None)
    mavlink_1 = bytes(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(one, force_mavlink1=True))
    assert signing.accepts(mavlink_1) is accepted
    assert signing.accepts(heartbeat(client(OTHER_KEY))) is accepted  # PX4 has the same check of these
    assert signing.refused == ({} if accepted else {"unsigned": 2, "wrong signature": 1})


def test_a_radios_status_is_always_accepted() -> None:
    signing = vehicle_signing()
    status = dialect.MAVLink_radio_status_message(1, 1, 1, 1, 1, 1, 1)
    assert signing.accepts(bytes(status.pack(client(None))))
    assert signing.accepts(bytes(status.pack(client(None), force_mavlink1=True)))


def test_any_bit_changed_makes_the_signature_wrong() -> None:
    frame = heartbeat(client())
    for position in range(len(frame)):
        if position == 2:
            continue  # the flag itself: then it is unsigned
        damaged = bytearray(frame)
        damaged[position] ^= 0x10
        if damaged[0] == 0xFD and int.from_bytes(damaged[7:10], "little") == 0:
            assert not vehicle_signing().accepts(bytes(damaged))


def test_setup_signing_only_on_usb_link(harness: SimHarness) -> None:
    message = dialect.MAVLink_setup_signing_message(1, 1, KEY, START)
    harness.send(message, "onboard")
    assert not any(link.signing.has_key for link in harness.vehicle.links.values())
    harness.send(message, "gcs", (245, 190))
    assert harness.vehicle.links["gcs"].signing.has_key
    assert not harness.vehicle.links["onboard"].signing.has_key
    harness.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    harness.send(dialect.MAVLink_setup_signing_message(0, 0, KEY, START), "gcs", (245, 190))
    harness.fly(0.1)
    assert not harness.received("SETUP_SIGNING")  # a key is not forwarded
    harness.send(dialect.MAVLink_setup_signing_message(1, 1, bytes(32), 0), "gcs", (245, 190))
    assert not harness.vehicle.links["gcs"].signing.has_key


def test_an_endpoint_refuses_and_counts_over_a_real_socket() -> None:
    peer = mavutil.mavlink_connection("udpin:127.0.0.1:0", source_system=245)
    endpoint = UdpEndpoint("127.0.0.1", 0, peer.port.getsockname()[1])
    endpoint.signing = vehicle_signing()
    address = ("127.0.0.1", endpoint.port)
    good = heartbeat(client())
    wrong, unsigned = heartbeat(client(OTHER_KEY)), heartbeat(client(None))
    for frame in (wrong, unsigned, good, good):
        peer.port.sendto(frame, address)
    accepted: list[Any] = []
    deadline = time.monotonic() + 10.0
    while endpoint.signing.refused.total() < 3 and time.monotonic() < deadline:
        accepted += endpoint.receive()
    assert len(accepted) == 1
    assert endpoint.signing.refused == {"wrong signature": 1, "unsigned": 1, "replayed": 1}
    endpoint.close()
    peer.close()


def test_a_key_comes_as_digits_or_from_a_file(tmp_path: Path) -> None:
    assert key_of(KEY.hex()) == KEY
    (tmp_path / "key").write_bytes(KEY)
    assert key_of(str(tmp_path / "key")) == KEY


# ---- pymavlink's own connection against the running vehicle


@pytest.fixture(scope="module")
def ports() -> Iterator[tuple[int, int]]:
    with running_simulator(signing_key=KEY.hex(), speed=4.0) as simulator:
        yield simulator.onboard_port, simulator.gcs_port


def refused_unsigned(codec: Any, message_id: int) -> bool:
    return False


def test_mavutil_with_the_key_flies(ports: tuple[int, int]) -> None:
    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{ports[1]}", source_system=245)
    try:
        assert link.wait_heartbeat(timeout=20) is not None  # mavutil finds out about MAVLink 2 by it
        link.setup_signing(KEY, sign_outgoing=True, allow_unsigned_callback=refused_unsigned)
        assert link.wait_heartbeat(timeout=20).get_signed()
        armed = False
        deadline = time.monotonic() + 40.0
        while not armed and time.monotonic() < deadline:
            link.mav.command_long_send(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
            answer = link.recv_match(type="COMMAND_ACK", blocking=True, timeout=5)
            armed = answer is not None and answer.result == 0
        assert armed
        link.mav.command_long_send(1, 1, 22, 0, *[float("nan")] * 7)
        height = 0.0
        while height < 1.5 and time.monotonic() < deadline:
            height = link.recv_match(type="GLOBAL_POSITION_INT", blocking=True, timeout=5).relative_alt / 1000
        assert height >= 1.5
        assert link.mav.signing.badsig_count == 0
        assert link.mav.signing.sig_count > 20
    finally:
        link.close()


@pytest.mark.parametrize("key", [None, OTHER_KEY], ids=["unsigned", "wrong_key"])
def test_mavutil_without_key_is_ignored(ports: tuple[int, int], key: bytes | None) -> None:
    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{ports[0]}", source_system=1, source_component=191)
    try:
        assert link.wait_heartbeat(timeout=20) is not None
        if key is not None:
            link.setup_signing(key, sign_outgoing=True, allow_unsigned_callback=lambda codec, message: True)
        for _ in range(20):
            link.mav.ping_send(0, 77, 0, 0)
            link.recv_match(type="ATTITUDE", blocking=True, timeout=5)
        link.setup_signing(KEY, sign_outgoing=True, allow_unsigned_callback=refused_unsigned)
        link.mav.ping_send(0, 78, 0, 0)
        while True:  # answers arrive in order: one to the first would be here already
            answer = link.recv_match(type="PING", blocking=True, timeout=20)
            assert answer is not None
            if answer.target_system == 1:
                break
        assert answer.seq == 78
    finally:
        link.close()


def test_the_clock_of_signatures_counts_from_2015() -> None:
    assert timestamp_now() / 1e5 == pytest.approx(time.time() - 1_420_070_400, abs=5.0)
