"""MCAP files (https://mcap.dev/spec): a crash costs a second at most, and a damaged file is read."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from companion.recording import RecordingError
from vision.file_kinds import explained, open_file

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "companion"
CHUNK_BYTES = 1 << 20
# A chunk is written at least this often: what a crash or a cut loses.
FLUSH_S = 1.0
# The rest of the computer needs space too: its logs, and a shell to remove files.
KEPT_FREE_BYTES = 200_000_000
PRIVATE, PRIVATE_FOLDER = 0o600, 0o700
"""Modes of what is made: images and positions are for its owner."""
_HEADER_BYTES = 9  # opcode and length of a record
_LARGEST_RECORD_BYTES = 1 << 30
# Of our own files: only these are removed for space.
_NAME = re.compile(r"[\w.-]+_\d{8}T\d{6}Z(-\d+)?_\d{3,}\.mcap")


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel of a file. `schema` is a JSON Schema, or empty for `encoding` other than json."""

    topic: str
    schema_name: str = ""
    schema: bytes = b""
    encoding: str = "json"


class Recorded(NamedTuple):
    """One message of a file. `log_time_ns`: Unix time."""

    channel: Channel
    log_time_ns: int
    data: bytes


class RecordingWriter:
    """Writes messages to a sequence of files in one folder.

    A file ends at its largest size or duration; then the next part begins. While all recordings in the folder
    are larger than `max_total_bytes`, the oldest file is removed.

    Args:
        name: the first word of the files' names.

    Attributes:
        path: the current file.
        begins: messages that every further part begins with, by topic; set by the owner.

    Raises:
        RecordingError: the folder or a file cannot be written, here and from `write` and `flush`. The file is
            then cut after its last whole chunk. Fewer than `KEPT_FREE_BYTES` are free, here and from `flush`:
            the file is then complete.
    """

    def __init__(
        self, directory: Path, name: str, *, max_bytes: int, max_duration_s: float, max_total_bytes: int
    ) -> None:
        self._directory = directory
        self._prefix = f"{name}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
        self._max_bytes, self._max_duration_s = max_bytes, max_duration_s
        self._max_total_bytes = max_total_bytes
        self._part = 0
        self.begins: dict[str, Recorded] = {}
        try:
            directory.mkdir(PRIVATE_FOLDER, parents=True, exist_ok=True)
        except OSError as error:
            raise RecordingError(f"{directory}: the folder cannot be made: {error.strerror}") from error
        self._check_space()
        self._open()

    def write(self, channel: Channel, log_time_ns: int, data: bytes) -> None:
        """Add a message; written with its chunk."""
        with self._cut_on_failure():
            self._messages.add(channel, log_time_ns, data)

    def flush(self) -> None:
        """Write what is pending, begin the next part if it is due, and remove old files. Call each second."""
        with self._cut_on_failure():
            self._messages.writer.flush()  # type: ignore[no-untyped-call]
            self._file.sync()
        if self._file.size >= self._max_bytes or time.monotonic() - self._began_s >= self._max_duration_s:
            self.begin_next()
        self._remove_old()
        try:
            self._check_space()
        except RecordingError:
            self.close()
            raise

    def begin_next(self) -> None:
        """End the file and begin the next one."""
        self.close()
        self._part += 1
        self._open()
        for message in self.begins.values():
            self.write(*message)

    def close(self) -> None:
        """Write the rest and the summary."""
        with self._cut_on_failure():
            self._messages.writer.finish()  # type: ignore[no-untyped-call]
            self._file.sync()
        self._file.close()

    def _open(self) -> None:
        self._began_s = time.monotonic()
        for number in itertools.count(1):  # another recorder may have begun in the same second
            begin = self._prefix if number == 1 else f"{self._prefix}-{number}"
            self.path = self._directory / f"{begin}_{self._part:05d}.mcap"
            try:
                self._file = _File(self.path)
            except FileExistsError:
                continue
            except OSError as error:
                raise RecordingError(f"{self.path}: cannot be created: {error.strerror}") from error
            self._prefix = begin
            break
        with self._cut_on_failure():
            self._messages = _Messages(self._file)

    def _check_space(self) -> None:
        if free_bytes(self._directory) < KEPT_FREE_BYTES:
            kept_mb = KEPT_FREE_BYTES // 1_000_000
            raise RecordingError(f"{self._directory}: the disk is full: fewer than {kept_mb} MB are free")

    @contextlib.contextmanager
    def _cut_on_failure(self) -> Iterator[None]:
        whole = self._file.size
        try:
            yield
        except OSError as error:
            # Half a chunk is of no use, and on a full disk its space is.
            with contextlib.suppress(OSError):
                self._file.cut(whole)
            self._file.close()
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror}") from error

    def _remove_old(self) -> None:
        files = {path: path.stat() for path in self._directory.iterdir() if _NAME.fullmatch(path.name)}
        total = sum(status.st_size for status in files.values())
        for path in sorted(files, key=lambda path: (files[path].st_mtime_ns, path.name)):
            if total <= self._max_total_bytes:
                return
            if path == self.path:  # the oldest by a clock that was set back
                continue
            total -= files[path].st_size
            with contextlib.suppress(OSError):  # another recorder may have removed it
                path.unlink()


def free_bytes(directory: Path) -> int:
    """Return what an ordinary user may still write there. Raises RecordingError."""
    try:
        return shutil.disk_usage(directory).free
    except OSError as error:
        raise RecordingError(f"{directory}: cannot be read: {error.strerror}") from error


class _Messages:
    """A started MCAP writer that registers the channels it meets."""

    def __init__(self, file: Any) -> None:
        self.writer = Writer(file, CHUNK_BYTES, CompressionType.ZSTD)
        self.writer.start(PROFILE)
        self._schemas: dict[str, int] = {"": 0}
        self._channels: dict[str, int] = {}

    def add(self, channel: Channel, log_time_ns: int, data: bytes) -> None:
        identifier, name = self._channels.get(channel.topic), channel.schema_name
        if identifier is None:
            if name not in self._schemas:
                self._schemas[name] = self.writer.register_schema(name, "jsonschema", channel.schema)
            identifier = self.writer.register_channel(channel.topic, channel.encoding, self._schemas[name])
            self._channels[channel.topic] = identifier
        self.writer.add_message(identifier, log_time_ns, data, log_time_ns)


class _File:
    """An unbuffered file: nothing is left to be written when a write has failed."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, PRIVATE)
        self.size = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._descriptor, rest)
            self.size += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Nothing is buffered."""

    def sync(self) -> None:
        os.fdatasync(self._descriptor)

    def cut(self, size: int) -> None:
        os.ftruncate(self._descriptor, size)
        self.size = size

    def close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1


class RecordingReader:
    """Reads the messages of one file, in the order of writing. Only whole chunks are read.

    Attributes:
        problems: what could not be read, a line each; complete after `messages` has ended, as the next two.
        ended: whether the file has its end, without which `problems` has a line: it is still being recorded,
            or was cut off.
        metadata: name of a metadata record → its entries.

    Raises:
        RecordingError: the file cannot be read, or is not MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        self.ended = True
        self.metadata: dict[str, dict[str, str]] = {}
        try:
            with open_file(path) as file:
                begin = file.read(len(MAGIC))
                self._size = os.fstat(file.fileno()).st_size
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
        if not begin:
            raise RecordingError(f"{path}: the file is empty")
        if begin != MAGIC:
            raise RecordingError(explained(path, f"{path}: not an MCAP file"))

    def messages(self, *topics: str) -> Iterator[Recorded]:
        """Return the messages of these topics; none: of all."""
        self.problems, self.ended = [], True
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for record in self._records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, ChannelRecord):
                schema = schemas.get(record.schema_id)
                name, text = ("", b"") if schema is None else (schema.name, schema.data)
                channels[record.id] = Channel(record.topic, name, text, record.message_encoding)
            elif record.channel_id in channels:
                channel = channels[record.channel_id]
                if not topics or channel.topic in topics:
                    yield Recorded(channel, record.log_time, record.data)

    def _records(self) -> Iterator[Schema | ChannelRecord | Message]:
        at = len(MAGIC)
        with open_file(self.path) as file:
            file.seek(at)
            while True:
                header = file.read(_HEADER_BYTES)
                length = int.from_bytes(header[1:], "little")
                if len(header) < _HEADER_BYTES or at + _HEADER_BYTES + length > self._size:
                    file.seek(max(self._size - len(MAGIC), len(MAGIC)))
                    self.ended = file.read(len(MAGIC)) == MAGIC
                    what = "damaged" if self.ended else "not ended, still being recorded or cut off"
                    self.problems.append(f"{self.path}: {what}: no whole record at byte {at} of {self._size}")
                    return
                opcode = header[0]
                if opcode == Opcode.DATA_END:
                    return
                if opcode == Opcode.CHUNK and length <= _LARGEST_RECORD_BYTES:
                    try:
                        chunk = Chunk.read(ReadDataStream(BytesIO(file.read(length))))
                        records = breakup_chunk(chunk, validate_crc=True)
                    except Exception as error:  # of mcap, struct and the decompressor: no common base
                        self.problems.append(f"{self.path}: damaged chunk at byte {at}: {error}")
                    else:
                        for record in records:
                            if isinstance(record, Schema | ChannelRecord | Message):
                                yield record
                elif opcode == Opcode.METADATA and length <= _LARGEST_RECORD_BYTES:
                    try:
                        metadata = Metadata.read(ReadDataStream(BytesIO(file.read(length))))
                    except Exception as error:  # as above
                        self.problems.append(f"{self.path}: damaged metadata at byte {at}: {error}")
                    else:
                        self.metadata[metadata.name] = metadata.metadata
                at += _HEADER_BYTES + length
                file.seek(at)


def recover(path: Path, output: Path) -> tuple[list[str], int]:
    """Copy what can be read to a new, complete file. Returns the problems and the number of messages.

    Raises:
        RecordingError: the file cannot be read, or the new one cannot be written or exists.
    """
    reader = RecordingReader(path)
    count = write_messages(output, reader.messages(), reader.metadata)
    return reader.problems, count


def write_messages(
    output: Path, messages: Iterable[Recorded], metadata: Mapping[str, Mapping[str, str]]
) -> int:
    """Write a new, complete file. Returns the number of messages.

    Args:
        metadata: name of a record → its entries; read after the messages.

    Raises:
        RecordingError: the file cannot be written or exists.
    """
    count = 0
    with new_file(output) as file:
        writer = _Messages(file)
        for count, message in enumerate(messages, 1):  # noqa: B007 - counted
            writer.add(*message)
        for name, entries in metadata.items():
            writer.writer.add_metadata(name, dict(entries))
        writer.writer.finish()  # type: ignore[no-untyped-call]
    return count


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, PRIVATE)


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file; it is removed if the block raises.

    Raises:
        RecordingError: the file exists or cannot be written.
    """
    try:
        with open(path, "xb", opener=_private) as file:
            try:
                yield file
                file.flush()
            except BaseException:
                path.unlink()
                raise
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
