"""MAVLink 2 message signing (https://mavlink.io/en/guide/message_signing.html) of one link.

Every sent frame is signed. Received frames that are unsigned, signed with another key or replayed are refused
and counted, except a telemetry radio's own messages, as the specification advises.

Timestamps never go back: not with the clock, and not over a restart (`kept_timestamp`). They follow the clock
and the newest signed frame that was accepted.
"""

from __future__ import annotations

import hashlib
import logging
import os
import secrets
import stat
from collections import Counter
from pathlib import Path

from companion.host.state_folder import state_folder
from companion.settings.key_files import KeyFileError, check_private
from companion.vehicle.driver import LinkError
from companion.vehicle.framing import MAGIC_V2, SIGNATURE_LENGTH, Frame, is_signed, marked_signed
from companion.vehicle.kept_timestamp import LATEST, ONE_MINUTE, KeptTimestamp, timestamp_now
from vision.file_kinds import kind_of_bytes, open_file
from vision.text_file import decode_text

logger = logging.getLogger(__name__)

KEY_LENGTH = 32
MAX_KEY_FILE_BYTES = 4096
NO_KEY = bytes(KEY_LENGTH)
"""PX4 1.17 signs with it while it has no key, and accepts everything."""
_RADIO_STATUS_ID, _HEARTBEAT_ID = 109, 0
_TELEMETRY_RADIO = 68  # MAV_COMP_ID_TELEMETRY_RADIO
_LINK_ID = 0
_OLD = "old timestamp"


class SigningKeyError(LinkError, ValueError):
    """The key file cannot be used. The message never contains the key."""


def read_key(path: str | Path) -> bytes:
    """Read the signing key from a file readable by its owner only: 32 raw bytes, or a passphrase.

    A passphrase is UTF-8 text of any other length; the key is its SHA-256, without surrounding white space,
    as in ground stations.

    Raises:
        SigningKeyError: no such file, readable by others, another owner, empty, or not text.
    """
    path = Path(path)
    try:
        with open_file(path) as file:
            status = os.fstat(file.fileno())
            content = file.read(MAX_KEY_FILE_BYTES + 1) if stat.S_ISREG(status.st_mode) else b""
    except OSError as error:
        raise SigningKeyError(f"signing key {path}: cannot be read: {error.strerror}") from error
    if not stat.S_ISREG(status.st_mode):
        raise SigningKeyError(f"signing key {path}: expected a regular file")
    try:
        check_private(path, status)
    except KeyFileError as error:
        raise SigningKeyError(f"signing key {error}") from None
    if status.st_uid not in (os.geteuid(), 0):
        raise SigningKeyError(f"signing key {path}: owned by another user; change its owner")
    if len(content) == KEY_LENGTH:
        return content
    if len(content) > MAX_KEY_FILE_BYTES:
        raise SigningKeyError(
            f"signing key {path}: expected {KEY_LENGTH} bytes or a passphrase, got more than "
            f"{MAX_KEY_FILE_BYTES} bytes"
        )
    if content and (kind := kind_of_bytes(content)) is not None:
        raise SigningKeyError(f"signing key {path}: {kind}")
    try:
        passphrase = decode_text(content).strip()
    except UnicodeDecodeError:
        passphrase = ""
    if not passphrase or "\0" in passphrase:
        raise SigningKeyError(
            f"signing key {path}: expected {KEY_LENGTH} bytes or a passphrase, got {len(content)} bytes that "
            "are neither"
        )
    return hashlib.sha256(passphrase.encode()).digest()


def write_new_key(path: Path) -> None:
    """Write a random passphrase of 43 characters to a new file that only its owner can read.

    Raises:
        SigningKeyError: the file exists already, or cannot be written.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            with open(descriptor, "w", encoding="ascii") as file:
                os.fchmod(descriptor, 0o600)
                file.write(f"{secrets.token_urlsafe(KEY_LENGTH)}\n")
                file.flush()
                os.fsync(descriptor)
        except OSError:  # the disk is full: no part of a key stays
            path.unlink(missing_ok=True)
            raise
    except FileExistsError:
        raise SigningKeyError(f"{path}: exists already, and may be in use; give another name") from None
    except OSError as error:
        raise SigningKeyError(f"{path}: cannot be written: {error.strerror}") from error


def signer_of(key_file: str | Path) -> FrameSigner:
    """Return the signer of a service with the key in a file; its timestamps go on from those before.

    Raises:
        SigningKeyError: as `read_key`.
    """
    return FrameSigner(read_key(key_file), KeptTimestamp(state_folder()))


class FrameSigner:
    """Signs the sent frames of one link and checks the received ones.

    Attributes:
        key: 32 bytes.
        refused: reason → number of refused frames.
        peer_late: the newest frame had the right key, and a time of more than a minute ago.
    """

    def __init__(self, key: bytes, kept: KeptTimestamp | None = None) -> None:
        """Raises ValueError for a key of another length than 32 bytes.

        Args:
            kept: from which timestamps go on, and where they are kept; None: nowhere.
        """
        if len(key) != KEY_LENGTH:
            raise ValueError(f"a signing key must have {KEY_LENGTH} bytes, got {len(key)}")
        self.key = key
        self._kept = kept
        self._timestamp = 0 if kept is None else kept.start
        self._newest: dict[tuple[int, int, int], int] = {}
        self.refused: Counter[str] = Counter()
        self.peer_late = False

    def __repr__(self) -> str:
        return f"FrameSigner({sum(self.refused.values())} refused)"

    def signed(self, frame: bytes) -> bytes:
        """Sign a packed MAVLink 2 frame; MAVLink 1 cannot be signed and is returned unchanged."""
        if frame[0] != MAGIC_V2 or is_signed(frame):
            return frame
        marked = marked_signed(frame) + bytes((_LINK_ID,)) + self.next_timestamp().to_bytes(6, "little")
        return marked + hashlib.sha256(self.key + marked).digest()[:6]

    def next_timestamp(self) -> int:
        """Return a timestamp that is later than all before, in units of 10 us since 2015."""
        self._advance(max(self._timestamp + 1, timestamp_now()))
        return self._timestamp

    def follow(self, frame: Frame) -> None:
        """Let own timestamps go on from that of a frame whose signature is right."""
        timestamp = int.from_bytes(frame.raw[-12:-6], "little")
        if self._timestamp < timestamp <= LATEST:
            self._advance(timestamp)

    def _advance(self, timestamp: int) -> None:
        self._timestamp = timestamp
        if self._kept is not None:
            self._kept.passed(timestamp)

    def accepts(self, frame: Frame) -> bool:
        """Whether a received frame is accepted; refused ones are counted, the first per reason is logged."""
        reason = self._rejection_reason(frame)
        self.peer_late = reason == _OLD
        if reason is None:
            return True
        self.refused[reason] += 1
        if self.refused[reason] == 1:
            logger.warning(
                "frame of %d/%d refused by signing: %s; further ones are only counted",
                frame.system_id,
                frame.component_id,
                reason,
            )
        return False

    def _rejection_reason(self, frame: Frame) -> str | None:
        raw = frame.raw
        if not is_signed(raw):
            return None if is_radio_message(frame) else "unsigned"
        if not is_signed_with(raw, self.key):
            return "wrong signature"
        stream = (frame.system_id, frame.component_id, raw[-SIGNATURE_LENGTH])
        timestamp = int.from_bytes(raw[-12:-6], "little")
        newest = self._newest.get(stream)
        if newest is None:
            if timestamp + ONE_MINUTE < max(self._timestamp, timestamp_now()):
                return _OLD
        elif timestamp <= newest:
            return "replayed"
        self._newest[stream] = timestamp
        self.follow(frame)
        return None


def is_signed_with(raw: bytes, key: bytes) -> bool:
    """Whether a complete frame carries a signature made with a key."""
    return is_signed(raw) and hashlib.sha256(key + raw[:-6]).digest()[:6] == raw[-6:]


def is_signed_with_a_key(raw: bytes) -> bool:
    """Whether a complete frame is signed, and not with PX4's key of zeros."""
    return is_signed(raw) and not is_signed_with(raw, NO_KEY)


def is_radio_message(frame: Frame) -> bool:
    """Whether a telemetry radio sent the frame: it has no key."""
    if frame.message_id == _RADIO_STATUS_ID:
        return True
    return frame.message_id == _HEARTBEAT_ID and frame.component_id == _TELEMETRY_RADIO
