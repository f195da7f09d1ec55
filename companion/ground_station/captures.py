"""Photos and videos of one camera, from the images on the bus, as files in `recording.directory`.

Files are written by a thread. What it has not done yet is bounded: a photo waits for a later image, an image
of a video is left out.
"""

from __future__ import annotations

import errno
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vision.image_file import decode_image
from vision.video_writer import VideoWriter, VideoWriterError

PHOTOS, VIDEOS = "photos", "videos"
_PRIVATE, _PRIVATE_FOLDER = 0o600, 0o700
# The recorder keeps the same free, and so does it of ours.
KEPT_FREE_BYTES = 200_000_000
_S = 1_000_000_000
# Without an image for so long a photo has failed.
IMAGE_TIMEOUT_S = 5.0
_MOST_JOBS = 4
_STORAGE_NS = _S
_SHORTEST_INTERVAL_S = 0.1
_MIB = 1 << 20


@dataclass(frozen=True, slots=True)
class Photo:
    """A photo that was taken, or not.

    Attributes:
        index: from 0. captured_ns: of its image; of a failure, when it failed.
        path: its file; None: it was not taken. reason: why.
    """

    index: int
    captured_ns: int
    path: Path | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Storage:
    """Space on the disk, MiB. `used`: by everything."""

    total: float
    used: float
    free: float


class Captures:
    """Takes photos and videos.

    Args:
        directory: `recording.directory`; None: it is not set, and nothing can be taken.
        camera: first word of the files' names. rate_hz: of videos.
        warn: called with a line, in the caller's thread.

    Attributes:
        image_count: photos so far, failures included.
        storage: of the disk; None: not known yet, or none.
        dropped: images of the video that the disk or the encoder was too slow for.
    """

    def __init__(
        self, directory: Path | None, camera: str, *, rate_hz: float, warn: Callable[[str], None]
    ) -> None:
        self.directory, self._camera, self._rate_hz, self._warn = directory, camera, rate_hz, warn
        self.image_count = self.dropped = 0
        self.storage: Storage | None = None
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="captures")
        self._jobs: deque[tuple[Future[None], Callable[[str], Photo | None]]] = deque()
        self._remaining: int | None = 0  # None: without end
        self._interval_s = 0.0
        self._next_ns = 0
        self._writing = 0  # photos
        self._video: _Video | None = None
        self._video_ns = 0
        self._storage_ns: int | None = None

    # --- commands ------------------------------------------------------------------------------------

    def start_photos(self, interval_s: float, count: int, now_ns: int) -> None:
        """Take `count` photos, the first now; 0: without end."""
        self._remaining, self._next_ns = count or None, now_ns
        self._interval_s = max(interval_s, _SHORTEST_INTERVAL_S) if count != 1 else 0.0

    def stop_photos(self) -> None:
        """Take no more photos."""
        self._remaining = 0

    def start_video(self, now_ns: int) -> None:
        """Begin a video, if none is recorded."""
        if self._video is None:
            self._video, self._video_ns = _Video(self._path(VIDEOS, "webm"), self._rate_hz), now_ns
            self.dropped = 0

    def stop_video(self) -> None:
        """Complete the video."""
        if (video := self._video) is not None:
            self._video = None
            if self.dropped:
                self._warn(
                    f"video of camera {self._camera}: {self.dropped} images left out, for which the disk or "
                    "the encoder was too slow"
                )
            self._submit(video.close, partial(self._on_video, video))

    # --- state ---------------------------------------------------------------------------------------

    @property
    def is_wanted(self) -> bool:
        """Whether images are needed."""
        return self._remaining != 0 or self._video is not None

    @property
    def image_status(self) -> int:
        """As of CAMERA_CAPTURE_STATUS: 0 idle, 1 taking a photo, 2 interval, 3 interval and taking."""
        return (2 if self._interval_s else 1) if self._remaining != 0 else int(self._writing > 0)

    @property
    def interval_s(self) -> float:
        """Interval of photos; 0: none is taken at an interval."""
        return self._interval_s if self._remaining != 0 else 0.0

    def recording_ms(self, now_ns: int) -> int | None:
        """Return since when a video is recorded, milliseconds; None: none is."""
        return None if self._video is None else max(now_ns - self._video_ns, 0) // 1_000_000

    # --- images --------------------------------------------------------------------------------------

    def on_image(self, jpeg: bytes, captured_ns: int, now_ns: int) -> None:
        """Use an image, JPEG."""
        if self._video is not None:
            if len(self._jobs) < _MOST_JOBS:
                write = partial(self._video.write, jpeg, captured_ns)
                self._submit(write, partial(self._on_video, self._video))
            else:
                self.dropped += 1
        # An image of before the command is not meant; stamps of another clock are after a second.
        late = now_ns - self._next_ns > _S
        ready = self._remaining != 0 and now_ns >= self._next_ns and (late or captured_ns >= self._next_ns)
        if ready and len(self._jobs) < _MOST_JOBS:
            index = self._count_photo(now_ns)
            path = self._path(PHOTOS, "jpg", index)
            self._writing += 1

            def done(reason: str) -> Photo:
                self._writing -= 1
                return self._photo(index, captured_ns, path, reason)

            self._submit(partial(_write, path, jpeg), done)

    def due(self, now_ns: int) -> Iterator[Photo]:
        """Yield the photos that are done. To be called often."""
        if self._remaining != 0 and now_ns - self._next_ns > IMAGE_TIMEOUT_S * _S:
            reason = f"no image within {IMAGE_TIMEOUT_S:g} s"
            yield self._photo(self._count_photo(now_ns), now_ns, None, reason)
        while self._jobs and self._jobs[0][0].done():
            job, done = self._jobs.popleft()
            error = job.exception()
            if (photo := done("" if error is None else _error_text(error))) is not None:
                yield photo
        if self.directory is not None and (self._storage_ns or 0) <= now_ns - _STORAGE_NS:
            self._storage_ns = now_ns
            self._submit(partial(self._read_storage, self.directory), lambda _: None)

    def close(self) -> None:
        """Complete the video and wait for the files."""
        self.stop_photos()
        self.stop_video()
        self._executor.shutdown()

    def _count_photo(self, now_ns: int) -> int:
        if self._remaining is not None:
            self._remaining -= 1
        self._next_ns = max(self._next_ns + round(self._interval_s * _S), now_ns - _S)
        self.image_count += 1
        return self.image_count - 1

    def _photo(self, index: int, captured_ns: int, path: Path | None, reason: str) -> Photo:
        if reason:
            self._warn(f"photo of camera {self._camera} not taken: {reason}")
        return Photo(index, captured_ns, None if reason else path, reason)

    def _on_video(self, video: _Video, reason: str) -> None:
        if reason and not video.failed:
            video.failed = True
            self._warn(f"video of camera {self._camera} ended: {reason}")
            if self._video is video:
                self.stop_video()

    def _read_storage(self, directory: Path) -> None:
        total, used, free = shutil.disk_usage(_existing(directory))
        self.storage = Storage(total / _MIB, used / _MIB, max(free - KEPT_FREE_BYTES, 0) / _MIB)

    def _submit(self, work: Callable[[], None], done: Callable[[str], Photo | None]) -> None:
        self._jobs.append((self._executor.submit(work), done))

    def _path(self, folder: str, suffix: str, index: int | None = None) -> Path:
        assert self.directory is not None
        number = "" if index is None else f"_{index:04d}"
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        return self.directory / folder / f"{self._camera}_{stamp}{number}.{suffix}"


class _Video:
    """A video on its way to a file, in the thread."""

    def __init__(self, path: Path, rate_hz: float) -> None:
        self._path, self._rate_hz = path, rate_hz
        self._writer: VideoWriter | None = None
        self._damaged = 0
        self.failed = False

    def write(self, jpeg: bytes, captured_ns: int) -> None:
        _check_space(self._path)
        image = decode_image(jpeg)
        if image is None:
            self._damaged += 1
            return
        if self._writer is None:
            height, width = image.shape[:2]
            self._writer = VideoWriter(self._path, width, height, self._rate_hz)
        self._writer.write(image, captured_ns)

    def close(self) -> None:
        if self._writer is None:
            raise VideoWriterError(f"{self._path}: there was no image for it")
        self._writer.close()
        if self._damaged:
            raise VideoWriterError(f"{self._path}: without {self._damaged} images, which are damaged")


def _write(path: Path, jpeg: bytes) -> None:
    _check_space(path)
    part = path.with_suffix(".part")
    try:
        with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, _PRIVATE), "wb") as file:
            file.write(jpeg)
        part.rename(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _check_space(path: Path) -> None:
    path.parent.mkdir(mode=_PRIVATE_FOLDER, parents=True, exist_ok=True)
    if shutil.disk_usage(path.parent).free < KEPT_FREE_BYTES:
        raise OSError(
            errno.ENOSPC, f"fewer than {KEPT_FREE_BYTES // 1_000_000} MB are free", str(path.parent)
        )


def _existing(directory: Path) -> Path:
    return next(each for each in (directory.absolute(), *directory.absolute().parents) if each.exists())


def _error_text(error: BaseException) -> str:
    if isinstance(error, VideoWriterError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'file'}: {error.strerror}"
    return f"{type(error).__name__}: {error}"
