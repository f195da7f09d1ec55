"""Frames between two processes of one host through shared memory: a ring of slots, the newest frame wins.

A segment is a file in /dev/shm, mapped by both sides. The writer creates it under another name and then
renames it, so a reader sees either none or a complete one. The writer holds a lock (`fcntl.flock`) on it: the
kernel releases the lock when the writer dies, and the next writer of the name then replaces the segment.
Readers detect that by the file's identity and map the new one. (`multiprocessing.shared_memory` is not used:
its resource tracker on Python 3.11 removes a segment when any reader exits.)

Layout, in 64-bit words of the host's byte order; the slots begin at the second page:

| word | header | slot |
|---|---|---|
| 0 | magic | lock: 2 n + 1 while frame n is being written, 2 n + 2 when it is whole |
| 1 | version | the frame's sequence |
| 2, 3 | width, height | the frame's captured_ns |
| 4 | 1 if there is depth | |
| 5, 6 | slots, bytes of a slot | |
| 7 | frames written so far | |
| 8 | heartbeat: monotonic nanoseconds of the last write | |
| 9 | 1 when the writer has closed | |
| 10 | the writer's process number | |
| 11 | calibration, bits: 1 lens, 2 mount, 4 stabilized, 8 on a gimbal | |
| 12 | number of distortion coefficients: 0, 4, 5 or 8 | |
| 13 to 16 | fx, fy, cx, cy in pixels (float64, as all below) | |
| 17 to 24 | distortion coefficients, see `vision.camera_model` | |
| 25 to 27 | mount: forward, right, down of the body (FRD) in metres | |
| 28 to 30 | mount: roll, pitch, yaw in radians | |
| 31 | distortion model: 0 plumb_bob, 1 rational_polynomial, 2 equidistant (an integer) | |

A slot's image starts 64 bytes into it, its depth after the image, at a multiple of 64. The slot's lock is a
sequence lock (Lameter 2005, "Effective synchronization on Linux/NUMA systems"): a reader copies and then
checks whether it has changed. With several slots it changes only for a reader more than `slots - 1` frames
late.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import secrets
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vision.camera_model import DISTORTION_MODELS, CameraCalibration, CameraModel, CameraMount
from vision.frame import Frame

SHARED_MEMORY_DIRECTORY = Path("/dev/shm")
MAGIC = 0x4D43_4652_414D_4531
VERSION = 3
PAGE = 4096
SLOT_HEADER_BYTES = 64
MAX_ATTEMPTS = 50
LOOK_FOR_SUCCESSOR_NS = 100_000_000
_LONGEST_NAME = 200

_MAGIC, _VERSION, _WIDTH, _HEIGHT, _DEPTH, _SLOTS, _SLOT_BYTES, _WRITTEN, _HEARTBEAT, _CLOSED, _PID = range(
    11
)
_CALIBRATION, _COEFFICIENTS, _DISTORTION_MODEL = 11, 12, 31
_LENS, _DISTORTION, _POSITION, _ROTATION = slice(13, 17), slice(17, 25), slice(25, 28), slice(28, 31)
_HAS_LENS, _HAS_MOUNT, _STABILIZED, _ON_GIMBAL = 1, 2, 4, 8
_LOCK, _SEQUENCE, _CAPTURED = range(3)

Words = NDArray[np.uint64]


def segment_path(name: str) -> Path:
    """The file of a segment. Raises ValueError for a name that is not a plain file name."""
    if not name or name in (".", "..") or "/" in name or "\0" in name or len(name) > _LONGEST_NAME:
        raise ValueError(
            f"the name of a shared memory must be a plain file name of at most {_LONGEST_NAME} characters, "
            f"got {name[:80]!r}"
        )
    if not SHARED_MEMORY_DIRECTORY.is_dir():
        raise FileNotFoundError(
            f"{SHARED_MEMORY_DIRECTORY} does not exist; shared frames need Linux's tmpfs there"
        )
    return SHARED_MEMORY_DIRECTORY / name


def _up(size: int, step: int) -> int:
    return -(-size // step) * step


class _Slots:
    """Views into a mapped segment: its header, and each slot's header, image and depth."""

    def __init__(self, memory: mmap.mmap, width: int, height: int, depth: bool, slots: int) -> None:
        self.header: Words = np.frombuffer(memory, np.uint64, PAGE // 8)
        stride = slot_bytes(width, height, depth)
        self.words: list[Words] = []
        self.images: list[NDArray[np.uint8]] = []
        self.depths: list[NDArray[np.float32] | None] = []
        for index in range(slots):
            start = PAGE + index * stride
            image_at = start + SLOT_HEADER_BYTES
            depth_at = image_at + _up(width * height * 3, 64)
            self.words.append(np.frombuffer(memory, np.uint64, SLOT_HEADER_BYTES // 8, start))
            image = np.frombuffer(memory, np.uint8, width * height * 3, image_at)
            self.images.append(image.reshape(height, width, 3))
            plane = np.frombuffer(memory, np.float32, width * height, depth_at) if depth else None
            self.depths.append(None if plane is None else plane.reshape(height, width))


def slot_bytes(width: int, height: int, depth: bool) -> int:
    """Bytes of one slot, header included, in whole pages."""
    pixels = width * height
    return _up(SLOT_HEADER_BYTES + _up(3 * pixels, 64) + (4 * pixels if depth else 0), PAGE)


def _write_calibration(header: Words, calibration: CameraCalibration) -> None:
    model, mount = calibration.model, calibration.mount
    floats = header.view(np.float64)
    flags = _HAS_LENS
    floats[_LENS] = (model.fx, model.fy, model.cx, model.cy)
    header[_COEFFICIENTS] = len(model.distortion)
    header[_DISTORTION_MODEL] = DISTORTION_MODELS.index(model.distortion_model)
    floats[_DISTORTION][: len(model.distortion)] = model.distortion
    if mount is not None:
        flags |= _HAS_MOUNT | (mount.stabilized and _STABILIZED) | (mount.on_gimbal and _ON_GIMBAL)
        floats[_POSITION] = (mount.forward_m, mount.right_m, mount.down_m)
        floats[_ROTATION] = (mount.roll_rad, mount.pitch_rad, mount.yaw_rad)
    header[_CALIBRATION] = flags


def _read_calibration(header: Words, width: int, height: int) -> CameraCalibration | None:
    """Raises ValueError for an invalid calibration."""
    flags, count = int(header[_CALIBRATION]), int(header[_COEFFICIENTS])
    if not flags & _HAS_LENS:
        return None
    floats = header.view(np.float64)
    if not np.isfinite(floats[_LENS.start : _ROTATION.stop]).all():
        raise ValueError("the calibration contains numbers that are not finite")
    fx, fy, cx, cy = floats[_LENS].tolist()
    distortion = tuple(floats[_DISTORTION].tolist()[:count])
    kind = int(header[_DISTORTION_MODEL])
    if kind >= len(DISTORTION_MODELS):
        raise ValueError(f"the calibration has the unknown distortion model {kind}")
    mount = None
    if flags & _HAS_MOUNT:
        forward_m, right_m, down_m = floats[_POSITION].tolist()
        roll_rad, pitch_rad, yaw_rad = floats[_ROTATION].tolist()
        stabilized, on_gimbal = bool(flags & _STABILIZED), bool(flags & _ON_GIMBAL)
        mount = CameraMount(forward_m, right_m, down_m, roll_rad, pitch_rad, yaw_rad, stabilized, on_gimbal)
    model = CameraModel(width, height, fx, fy, cx, cy, distortion, DISTORTION_MODELS[kind])
    return CameraCalibration(model, mount)


class SharedFrameWriter:
    """Writes frames of one size under a name. One writer per name; the segment of a dead writer is replaced.

    Args:
        calibration: the camera's lens, at this size, and its mount, for readers; None: unknown.

    Raises:
        FileExistsError: another writer of that name is alive.
        ValueError: the name or a size is invalid.
    """

    def __init__(
        self,
        name: str,
        width: int,
        height: int,
        depth: bool,
        slots: int = 4,
        calibration: CameraCalibration | None = None,
    ) -> None:
        if calibration is not None and (calibration.model.width, calibration.model.height) != (width, height):
            raise ValueError(
                f"the calibration is for {calibration.model.width}x{calibration.model.height} pixels, "
                f"the frames have {width}x{height}"
            )
        if width <= 0 or height <= 0:
            raise ValueError(f"shared frames need a positive size, got {width}x{height}")
        if slots < 2:
            raise ValueError(f"a ring of shared frames needs at least 2 slots, got {slots}")
        self.name, self.width, self.height, self.depth = name, width, height, depth
        self._path = segment_path(name)
        stride = slot_bytes(width, height, depth)
        size = PAGE + slots * stride
        draft = self._path.with_name(f".{name}.{secrets.token_hex(6)}")
        self._file = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Allocate now: a full /dev/shm is an error here, not a SIGBUS in the middle of a frame.
            os.posix_fallocate(self._file, 0, size)
            self._memory = mmap.mmap(self._file, size)
            self._views: _Slots | None = _Slots(self._memory, width, height, depth, slots)
            header = self._views.header
            header[[_VERSION, _WIDTH, _HEIGHT, _DEPTH]] = (VERSION, width, height, int(depth))
            header[[_SLOTS, _SLOT_BYTES, _PID]] = (slots, stride, os.getpid())
            if calibration is not None:
                _write_calibration(header, calibration)
            header[_HEARTBEAT] = time.monotonic_ns()
            header[_MAGIC] = MAGIC
            _move_into_place(draft, self._path)
        except BaseException:
            with contextlib.suppress(FileNotFoundError):
                draft.unlink()
            os.close(self._file)
            raise

    def write(self, frame: Frame) -> None:
        """Copy a frame in. Raises ValueError if its size or presence of depth differs from the segment's."""
        if (frame.width, frame.height) != (self.width, self.height):
            raise ValueError(
                f"shared memory {self.name!r} holds {self.width}x{self.height} frames, "
                f"got {frame.width}x{frame.height}"
            )
        if (frame.depth_m is not None) != self.depth:
            raise ValueError(
                f"shared memory {self.name!r} was created {'with' if self.depth else 'without'} depth, "
                f"the frame has {'none' if self.depth else 'depth'}"
            )
        with self.slot(frame.sequence, frame.captured_ns) as (image, depth_m):
            image[:] = frame.image
            if depth_m is not None:
                depth_m[:] = frame.depth_m

    @contextlib.contextmanager
    def slot(
        self, sequence: int, captured_ns: int
    ) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32] | None]]:
        """The next frame's memory, to be filled inside the block: image, and depth if the segment has it.

        Both are as in `Frame`. Readers get the frame at the end of the block; after an exception they do not.
        """
        if self._views is None:
            raise ValueError(f"the writer of shared memory {self.name!r} is closed")
        header = self._views.header
        count = int(header[_WRITTEN])
        index = count % len(self._views.words)
        words = self._views.words[index]
        words[_LOCK] = 2 * count + 1
        words[_SEQUENCE] = sequence
        words[_CAPTURED] = captured_ns
        yield self._views.images[index], self._views.depths[index]
        words[_LOCK] = 2 * count + 2
        header[_WRITTEN] = count + 1
        header[_HEARTBEAT] = time.monotonic_ns()

    def close(self) -> None:
        """Mark the segment as closed and remove its name. Readers keep their mapping."""
        if self._views is None:
            return
        self._views.header[_CLOSED] = 1
        self._views = None
        if _same_file(self._path, self._file):
            self._path.unlink()
        self._memory.close()
        os.close(self._file)

    def __enter__(self) -> SharedFrameWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _move_into_place(draft: Path, path: Path) -> None:
    """Rename the draft, replacing the segment of a dead writer if there is one."""
    while True:
        try:
            os.link(draft, path)
            draft.unlink()
            return
        except FileExistsError:
            pass
        try:
            if _if_dead(path, lambda: os.replace(draft, path)):
                return
        except BlockingIOError as error:
            raise FileExistsError(
                f"shared memory {path.name!r} is being written by another process; stop it or choose another "
                "name"
            ) from error


def remove_leavings(name: str) -> bool:
    """Remove the segment of a killed writer; True if there was one. A living writer's segment stays."""
    path = segment_path(name)
    try:
        return _if_dead(path, path.unlink)
    except BlockingIOError:
        return False


def _if_dead(path: Path, act: Callable[[], object]) -> bool:
    """Run `act` on the segment of a dead writer; False if there is none. Raises BlockingIOError: it lives."""
    try:
        old = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(old, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not _same_file(path, old):
            return False
        act()
        return True
    finally:
        os.close(old)


def _same_file(path: Path, descriptor: int) -> bool:
    try:
        named = os.stat(path)
    except FileNotFoundError:
        return False
    opened = os.fstat(descriptor)
    return (named.st_dev, named.st_ino) == (opened.st_dev, opened.st_ino)


class SharedFrameReader:
    """Reads the newest frame of the writer with that name. Any number of readers.

    Raises:
        FileNotFoundError: there is no segment of that name (yet).
        ValueError: the file is not a segment of this version.

    Attributes:
        reopened: number of new writers' segments opened.
        calibration: lens and mount of the writing camera; None: unknown to the writer.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.reopened = 0
        self._path = segment_path(name)
        self._views: _Slots | None = None
        self._checked_ns = 0
        self._new_writer = False
        self._open()

    def _open(self) -> None:
        file = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            size = os.fstat(file).st_size
            if size < PAGE:
                raise ValueError(f"{self._path} is not a segment of shared frames: only {size} bytes")
            memory = mmap.mmap(file, size, prot=mmap.PROT_READ)
            header: list[int] = np.frombuffer(memory, np.uint64, PAGE // 8)[: _PID + 1].tolist()
            if header[_MAGIC] != MAGIC:
                raise ValueError(
                    f"{self._path} is not a segment of shared frames (magic {header[_MAGIC]:#x})"
                )
            if header[_VERSION] != VERSION:
                raise ValueError(
                    f"{self._path} has layout version {header[_VERSION]}, expected {VERSION}: its writer "
                    f"(process {header[_PID]}) is from another release; restart it with this one"
                )
            width, height, depth, slots = (
                header[_WIDTH],
                header[_HEIGHT],
                bool(header[_DEPTH]),
                header[_SLOTS],
            )
            stride = slot_bytes(width, height, depth)
            if stride != header[_SLOT_BYTES] or size < PAGE + slots * stride:
                raise ValueError(
                    f"{self._path} is damaged: {size} bytes do not hold {slots} slots of {stride}"
                )
            self._views = _Slots(memory, width, height, depth, slots)
            try:
                self.calibration = _read_calibration(self._views.header, width, height)
            except ValueError as error:
                raise ValueError(f"{self._path} is damaged: {error}") from error
        except BaseException:
            os.close(file)
            raise
        self._file, self._memory = file, memory
        self.width, self.height, self.depth = width, height, depth

    def _release(self) -> None:
        if self._views is not None:
            self._views = None
            self._memory.close()
            os.close(self._file)

    def latest(self, after_sequence: int | None = None) -> Frame | None:
        """A copy of the newest frame if its sequence is above `after_sequence`, else None.

        A restarted writer counts from 0 again: its first frame is returned regardless of `after_sequence`.
        """
        self._follow_writer()
        if self._views is None:
            return None
        for _ in range(MAX_ATTEMPTS):
            views = self._views
            count = int(views.header[_WRITTEN])
            if count == 0:
                return None
            index = (count - 1) % len(views.words)
            words = views.words[index]
            before = int(words[_LOCK])
            sequence, captured_ns = int(words[_SEQUENCE]), int(words[_CAPTURED])
            if before == 2 * count:
                if after_sequence is not None and sequence <= after_sequence and not self._new_writer:
                    return None
                image = views.images[index].copy()
                depth = views.depths[index]
                depth_m = None if depth is None else depth.copy()
                if int(words[_LOCK]) == before:
                    self._new_writer = False
                    return Frame(image, captured_ns, sequence, depth_m)
        return None

    def _follow_writer(self) -> None:
        """Open the segment of a newer writer; checked at most every 0.1 s."""
        now = time.monotonic_ns()
        closed = self._views is None or bool(self._views.header[_CLOSED])
        if not closed and now - self._checked_ns < LOOK_FOR_SUCCESSOR_NS:
            return
        self._checked_ns = now
        if self._views is not None and _same_file(self._path, self._file):
            return
        if not self._path.exists():
            return
        self._release()
        with contextlib.suppress(FileNotFoundError):
            self._open()
            self.reopened += 1
            self._new_writer = True

    @property
    def writer_heartbeat_ns(self) -> int | None:
        """CLOCK_MONOTONIC nanoseconds of the writer's last write; None if it has closed or disappeared."""
        if self._views is None or bool(self._views.header[_CLOSED]):
            return None
        return int(self._views.header[_HEARTBEAT])

    def close(self) -> None:
        """Unmap. The segment itself stays with the writer."""
        self._release()
        self._path = Path(os.devnull) / "closed"

    def __enter__(self) -> SharedFrameReader:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
