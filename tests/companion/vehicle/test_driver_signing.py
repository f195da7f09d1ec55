"""MAVLink signing: the key file, signed and refused frames, against pymavlink and the simulator."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hashlib
import logging
import os
import socket
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.settings.reading import load_settings, to_toml
from companion.vehicle.commander import ONBOARD_CONTROLLER, read_commander
from companion.vehicle.driver import CommandRefusedError, LinkError, NoAnswerError
from companion.vehicle.drivers import open_driver
from companion.vehicle.framing import Frame, Framer
from companion.vehicle.signing import FrameSigner, SigningKeyError, read_key
from mavlink_sim.testing import free_port, running_simulator
from tests.companion.vehicle.fake_autopilot import wait_for_state, wait_until

pytestmark = pytest.mark.realtime

KEY = bytes(range(32))


def key_file(folder: Path, content: bytes, mode: int = 0o600) -> Path:
    path = folder / "signing.key"
    path.write_bytes(content)
    path.chmod(mode)
    return path


def frames(data: bytes) -> list[Frame]:
    return Framer().feed(data, datagram=True)


def heartbeat(system: int = 1, component: int = 1, *, key: bytes | None = None, timestamp: int = 0) -> bytes:
    """One frame packed by pymavlink, signed if there is a key."""
    codec = mavlink.MAVLink(None, system, component)
    if key is not None:
        codec.signing.secret_key = key
        codec.signing.sign_outgoing = True
        codec.signing.link_id = 3
        codec.signing.timestamp = timestamp
    return bytes(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(codec))


def now() -> int:
    signer = FrameSigner(KEY)
    return int.from_bytes(signer.signed(heartbeat())[-12:-6], "little")


def test_key_is_32_bytes_or_a_passphrase_hash(tmp_path: Path) -> None:
    assert read_key(key_file(tmp_path, KEY)) == KEY
    assert read_key(key_file(tmp_path, b"correct horse\n")) == hashlib.sha256(b"correct horse").digest()


@pytest.mark.parametrize(
    ("content", "mode", "reason"),
    [
        (KEY, 0o640, "chmod 600"),
        (KEY, 0o604, "chmod 600"),
        (b"", 0o600, "neither"),
        (b" \n", 0o600, "neither"),
        (b"\xff" * 31, 0o600, "neither"),
        (b"x" * 5000, 0o600, "4096 bytes"),
    ],
    ids=["group", "others", "empty", "blank", "bytes", "long"],
)
def test_unusable_key_file_is_refused_with_its_reason(
    tmp_path: Path, content: bytes, mode: int, reason: str
) -> None:
    path = key_file(tmp_path, content, mode)
    with pytest.raises(SigningKeyError, match=reason) as caught:
        read_key(path)
    assert str(path) in str(caught.value)
    with pytest.raises(SigningKeyError, match=rf"missing: .*{os.strerror(errno.ENOENT)}"):
        read_key(tmp_path / "missing")


@given(st.binary(min_size=0, max_size=40))
def test_pymavlink_accepts_our_signature(text: bytes) -> None:
    codec = mavlink.MAVLink(None, 1, 191)
    plain = mavlink.MAVLink_statustext_message(6, text).pack(codec)
    reader = mavlink.MAVLink(None, 1, 1)
    reader.signing.secret_key = KEY
    reader.signing.allow_unsigned_callback = lambda *_: False
    signed = FrameSigner(KEY).signed(bytes(plain))
    message = reader.decode(bytearray(signed))
    assert message.get_signed()
    assert message.get_type() == "STATUSTEXT"
    assert FrameSigner(KEY).signed(signed) == signed  # a signed frame is unchanged


def test_replayed_frame_is_refused() -> None:
    signer = FrameSigner(KEY)
    (frame,) = frames(heartbeat(key=KEY, timestamp=now()))
    assert signer.accepts(frame)
    assert not signer.accepts(frame)
    assert signer.refused == {"replayed": 1}


def test_unsigned_foreign_and_old_frames_are_refused() -> None:
    signer = FrameSigner(KEY)
    (unsigned,) = frames(heartbeat())
    (foreign,) = frames(heartbeat(key=bytes(32), timestamp=now()))
    (old,) = frames(heartbeat(key=KEY, timestamp=now() - 7_000_000))
    assert [signer.accepts(frame) for frame in (unsigned, foreign, old)] == [False] * 3
    assert signer.refused == {"unsigned": 1, "wrong signature": 1, "old timestamp": 1}
    (radio,) = frames(heartbeat(component=68))
    codec = mavlink.MAVLink(None, 51, 68)
    (status,) = frames(bytes(mavlink.MAVLink_radio_status_message(1, 1, 100, 1, 1, 0, 0).pack(codec)))
    assert signer.accepts(radio)
    assert signer.accepts(status)


def test_timestamps_increase() -> None:
    signer = FrameSigner(KEY)
    stamps = [int.from_bytes(signer.signed(heartbeat())[-12:-6], "little") for _ in range(200)]
    assert stamps == sorted(set(stamps))


def test_key_is_not_in_settings_or_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    path = key_file(tmp_path, b"open sesame")
    settings = load_settings(None, {"vehicle.signing_key_file": str(path)}, {})
    shown = to_toml(settings)
    assert str(path) in shown
    signer = FrameSigner(read_key(path))
    signer.accepts(frames(heartbeat())[0])
    output = shown + repr(signer) + caplog.text
    assert "sesame" not in output
    assert read_key(path).hex() not in output


# The driver signs for every autopilot with the same code.
@pytest.mark.parametrize("firmware", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
async def test_signed_link_works_and_wrong_key_is_reported(
    tmp_path: Path, firmware: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "simulator.key"
    path.write_bytes(KEY)
    with running_simulator(autopilot=firmware, signing_key=path, ready_after=0.0, speed=4.0) as simulator:
        url = f"udpin://127.0.0.1:{simulator.onboard_port}"
        other = open_driver("pymavlink", url, signer=FrameSigner(os.urandom(32)))
        with pytest.raises(LinkError, match=r"signature.*key"):
            await other.connect(2.0)
        driver = open_driver("pymavlink", url, signer=FrameSigner(KEY))
        await driver.connect(20.0)
        try:
            await wait_for_state(driver, lambda state: state.ready_to_arm)
            name = "COM_OF_LOSS_T" if firmware == "px4" else "GUID_TIMEOUT"
            assert await driver.get_parameter(name) > 0.0
            await driver.arm()
            await driver.disarm()
        finally:
            await driver.close()
        unsigned = open_driver("pymavlink", url)
        await unsigned.connect(20.0)
        try:
            # Without an answer it is not known whether an ArduPilot is Copter, so nothing is sent to it.
            why = r"no answer .*vehicle\.signing_key_file" if firmware == "px4" else "FRAME_CLASS"
            with pytest.raises(NoAnswerError if firmware == "px4" else CommandRefusedError, match=why):
                await unsigned.arm()
        finally:
            await unsigned.close()


async def test_a_peer_whose_clock_is_late_is_sent_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    with monkeypatch.context() as clock:
        created_ns = time.monotonic_ns() - 100_000_000_000
        clock.setattr(time, "monotonic_ns", lambda: created_ns)
        driver = open_driver("pymavlink", f"udpin://127.0.0.1:{port}", signer=FrameSigner(KEY))
    connecting = asyncio.create_task(driver.connect(20.0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.setblocking(False)
        autopilot.bind(("127.0.0.1", 0))
        autopilot.connect(("127.0.0.1", port))
        answers: list[bytes] = []

        def say(timestamp: int) -> None:
            with contextlib.suppress(ConnectionError):  # it may not listen yet
                autopilot.send(heartbeat(key=KEY, timestamp=timestamp))

        def answered() -> bool:
            say(now() - 7_000_000)
            with contextlib.suppress(BlockingIOError, ConnectionError):
                answers.append(autopilot.recv(2048))
            return bool(answers)

        try:
            await wait_until(answered, 10.0)
            assert driver.state.heartbeat_ns == 0
            (frame,) = frames(answers[0])
            assert (frame.system_id, frame.component_id) == driver.own_address
            assert FrameSigner(KEY).accepts(frame)
            custom_mode = int.from_bytes(frame.padded(4), "little")
            sender = read_commander(ONBOARD_CONTROLLER, custom_mode, driver.own_address, 0)
            assert sender is not None
            assert 100.0 <= sender.uptime_s <= 130.0
            say(int.from_bytes(frame.raw[-12:-6], "little") + 1)
            await wait_until(lambda: driver.state.heartbeat_ns > 0, 5.0)
        finally:
            connecting.cancel()
            await asyncio.gather(connecting, return_exceptions=True)
            await driver.close()
