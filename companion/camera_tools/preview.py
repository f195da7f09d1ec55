"""`companion preview` and `companion depth`: what a source delivers, as lines and as images in a folder."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.bus.bodies.frames import DepthBody
from companion.bus.messages import depth_message
from companion.perception.assembly import CameraTelemetry
from companion.settings import Settings
from companion.vehicle.state import VehicleState
from vision.annotate import annotate, annotate_level
from vision.depth import centre_depth
from vision.detections import Detections
from vision.frame import Frame
from vision.levelling import Levelling
from vision.pipeline import PerceptionResult, Pipeline
from vision.sources import EndOfStream, Source, SourceError

GREY_DIVISOR = 3
_RATE_WINDOW_S = 2.0


@dataclass(frozen=True, slots=True)
class PreviewOptions:
    """What is shown.

    Attributes:
        topic: where the service publishes this source's images.
        save: folder of the images, `<sequence>.jpg`; None: none are saved.
        grey: the image in grey, a third as wide and high.
        period_s: interval of lines and images, seconds; 0: every frame.
        limit: number of lines after which it ends; None: with the source.
        level: levels the images; None: they stay as they are.
    """

    topic: str
    save: Path | None = None
    grey: bool = False
    period_s: float = 1.0
    limit: int | None = None
    level: Levelling | None = None


def save_image(folder: Path, frame: Frame, image: NDArray[np.uint8]) -> None:
    """Write `<sequence>.jpg`. Raises OSError if it cannot be written."""
    path = folder / f"{frame.sequence:06d}.jpg"
    if not cv2.imwrite(str(path), image):
        raise OSError(f"cannot write {path}: check free disk space and write permission")


class RateMeter:
    """The rate of a source over the last two seconds, at least two frames, by stamps: lost frames count."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, int]] = deque()

    def add(self, captured_ns: int, sequence: int) -> float | None:
        """Add a frame; returns the rate in Hz, None before the second frame."""
        self._seen.append((captured_ns, sequence))
        while len(self._seen) > 2 and captured_ns - self._seen[0][0] > _RATE_WINDOW_S * 1e9:
            self._seen.popleft()
        first_ns, first = self._seen[0]
        return (sequence - first) * 1e9 / (captured_ns - first_ns) if captured_ns > first_ns else None


def preview_source(source: Source, options: PreviewOptions, write: Callable[[str], None]) -> int:
    """Print a line, and save an image, every `period_s` until the source ends.

    A source that ends after its first frame has one line.

    Returns:
        Number of lines.

    Raises:
        OSError: an image cannot be written.
    """
    if options.save is not None:
        options.save.mkdir(parents=True, exist_ok=True)
    meter = RateMeter()
    shown, due_s = 0, time.monotonic()
    only: Frame | None = None

    def show(frame: Frame, rate_hz: float | None) -> None:
        nonlocal shown
        lines = status_lines(source, frame, rate_hz, options.topic)
        write("  ".join(lines))
        if options.save is not None:
            save_image(
                options.save, frame, preview_image(frame, lines, grey=options.grey, level=options.level)
            )
        shown += 1

    for frame in source:
        rate_hz = meter.add(frame.captured_ns, frame.sequence)
        # The first frame has no rate yet.
        if time.monotonic() < due_s or (rate_hz is None and options.period_s > 0.0 and shown == 0):
            only = frame
            continue
        due_s = time.monotonic() + options.period_s
        show(frame, rate_hz)
        if shown == options.limit:
            break
    if only is not None and shown == 0:
        show(only, None)
    return shown


def status_lines(source: Source, frame: Frame, rate_hz: float | None, topic: str) -> tuple[str, ...]:
    """Device, topic, size and rate, stamp and losses."""
    age_ms = (time.monotonic_ns() - frame.captured_ns) / 1e6
    statistics = source.statistics
    rate = "" if rate_hz is None else f"  {rate_hz:.1f} Hz"
    return (
        source.uri,
        topic,
        f"{frame.width}x{frame.height}{rate}",
        f"stamp {frame.captured_ns / 1e9:.3f} s, {age_ms:.0f} ms ago",
        f"frame {frame.sequence}, {statistics.dropped} dropped, {statistics.unreadable} unreadable",
    )


def preview_image(
    frame: Frame, lines: tuple[str, ...], *, grey: bool, level: Levelling | None = None
) -> NDArray[np.uint8]:
    """The frame with its lines, (height, width, 3) BGR; with `grey` a third as wide and high."""
    if grey:
        size = (max(frame.width // GREY_DIVISOR, 1), max(frame.height // GREY_DIVISOR, 1))
        small = cv2.resize(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
        image = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR).astype(np.uint8, copy=False)
        depth_m = frame.depth_m
        if depth_m is not None:
            depth_m = cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST).astype(
                np.float32, copy=False
            )
        frame = replace(frame, image=image, depth_m=depth_m)
    return annotate_level(frame, Detections.empty(()), level, lines=lines)


@contextlib.contextmanager
def attitudes_of(settings: Settings) -> Iterator[CameraTelemetry]:
    """Receive the attitudes of the vehicle, and of its gimbal, in a thread meanwhile.

    Raises:
        LinkError: no heartbeat or no attitude was received within `vehicle.connect_timeout_s`, or the link
            cannot be opened.
    """
    from companion.guidance.objects.from_detections import HistoryError, StateHistory
    from companion.service.factory import driver_of
    from companion.vehicle.driver import LinkUnavailableError

    telemetry, history = CameraTelemetry(), StateHistory()
    opened: Future[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = Future()
    url, timeout_s = settings.vehicle.url, settings.vehicle.connect_timeout_s

    async def receive() -> None:
        driver, known, ended = driver_of(settings), asyncio.Event(), asyncio.Event()

        def on_state(state: VehicleState) -> None:
            history.add(state)
            if state.attitude is not None:
                telemetry.attitudes.add(state.attitude_ns, state.attitude)
            if state.gimbal is not None and state.gimbal.attitude is not None:
                with contextlib.suppress(HistoryError):
                    stamp_ns = state.gimbal.attitude_ns
                    telemetry.gimbal.add(stamp_ns, history.gimbal_at(stamp_ns))
            if telemetry.attitudes.at(time.monotonic_ns()) is not None:
                known.set()

        try:
            await driver.connect(timeout_s)
            driver.subscribe(on_state)
            async with asyncio.timeout(timeout_s):
                await known.wait()
            opened.set_result((asyncio.get_running_loop(), ended))
            await ended.wait()
        except TimeoutError:
            raise LinkUnavailableError(f"{url}: no attitude received within {timeout_s:g} s") from None
        finally:
            await driver.close()

    def run() -> None:
        try:
            asyncio.run(receive())
        except Exception as error:
            if opened.done():
                raise
            opened.set_exception(error)

    thread = threading.Thread(target=run, name="attitudes", daemon=True)
    thread.start()
    loop, ended = opened.result()
    try:
        yield telemetry
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()


class DepthRecorder:
    """Saves the frames of a pipeline with their detections and the depth at the centre.

    Args:
        folder: of the images; None: none are saved.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def write(self, frame: Frame, detections: Detections, /) -> None:
        """Save a frame. Raises OSError if it cannot be written."""
        if self._folder is not None and frame.depth_m is not None:
            centre_m = centre_depth(frame.depth_m)
            save_image(self._folder, frame, annotate(frame.image, detections, centre_m=centre_m))


def depth_source(
    pipeline: Pipeline,
    *,
    vehicle: str,
    limit: int | None,
    as_json: bool,
    write: Callable[[str], None],
) -> int:
    """Print the depth of each frame until the source ends.

    Args:
        pipeline: of an open source with depth.
        as_json: each line is the message of the topic `depth`.

    Returns:
        Number of lines.

    Raises:
        SourceError: the first frame has no depth, or the source failed.
    """
    shown = 0

    def deliver(result: PerceptionResult) -> None:
        nonlocal shown
        if result.depth is None:
            if not shown:
                raise SourceError(
                    "the source delivers no depth; name the depth of its images in source.depth"
                )
            return
        shown += 1
        message = depth_message(result, vehicle, time.monotonic_ns())
        write(json.dumps(message) if as_json else _depth_line(message))

    with contextlib.suppress(EndOfStream):
        while limit is None or shown < limit:
            pipeline.step(1.0, deliver)
    return shown


def _depth_line(message: DepthBody) -> str:
    boxes = ", ".join(f"{box['class_name']} {_metres(box['depth_m'])}" for box in message["boxes"])
    return (
        f"{message['sequence']:6d}  centre {_metres(message['centre_m'])}  "
        f"{message['valid_share']:6.1%} valid  {boxes}"
    ).rstrip()


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} m"
