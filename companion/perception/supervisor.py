"""The perception worker's supervisor: starts it, reads its messages, restarts it when it is dead or stuck.

Nothing here waits for the worker: its messages are processed as they arrive. A worker that is silent for too
long is killed. It is started again as `companion.host.restarts` says, without end.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from companion.host.load import with_load
from companion.host.passing import PassingError
from companion.host.restarts import Restart, Restarts
from companion.host.tasks import error_text, spawn
from companion.perception.messages import (
    AnyPreview,
    Attitude,
    CloudPreview,
    DepthPreview,
    Detecting,
    Ended,
    GimbalAttitude,
    Heartbeat,
    Hud,
    LogLine,
    Message,
    Preview,
    ProtocolError,
    Ready,
    Report,
    StartFailed,
    Watched,
)
from companion.perception.process import PerceptionProcess, RateLimiter, Watchdog
from companion.perception.standard_input import STANDARD_INPUT, StandardInput
from companion.perception.status import LiveTracks, PerceptionState, PerceptionStatus, StageTimes
from companion.settings import DetectorSection, Settings
from companion.vehicle.state import Vector3
from vision.attitude import Quaternion
from vision.camera_model import CameraCalibration
from vision.object_detector import resolve_classes
from vision.path_planner import PathRequest, PlannedPath
from vision.pipeline import PerceptionResult
from vision.tracking import TARGET_CLASS, Selected, SelectRequest, TrackEventKind

logger = logging.getLogger(__name__)

__all__ = ["PerceptionStartError", "PerceptionState", "PerceptionStatus", "PerceptionSupervisor"]

STOP_S, TERMINATE_S = 5.0, 1.0
# A selection is answered with the next processed frame.
SELECT_TIMEOUT_S = 3.0
_TICK_S = 0.25
_RATE_WINDOW_S = 2.0


class PerceptionStartError(RuntimeError):
    """Perception cannot start with its settings. The message is one line."""


class PerceptionUnavailableError(PerceptionStartError, PassingError):
    """Perception does not run now."""


@dataclass(frozen=True, slots=True)
class _End:
    """The end of a worker.

    Attributes:
        finished: normal, and it is not restarted.
        wrong_settings: it cannot start with its settings.
    """

    finished: bool
    text: str
    wrong_settings: bool = False


@dataclass(slots=True)
class _Counts:
    frames: int = 0
    dropped: int = 0
    frames_skipped: dict[str, int] = field(default_factory=dict)
    frames_repeated: dict[str, int] = field(default_factory=dict)

    def add(self, other: _Counts) -> None:
        self.frames += other.frames
        self.dropped += other.dropped
        self.frames_skipped = _sum(self.frames_skipped, other.frames_skipped)
        self.frames_repeated = _sum(self.frames_repeated, other.frames_repeated)


class PerceptionSupervisor:
    """Keeps one perception worker running. Everything is called, and calls back, in one asyncio loop.

    The loop must run in a long-lived thread: the kernel ends the worker when the thread that started it ends.

    Args:
        settings: the sections source, detector, recording and log are used by the worker.
        on_result: called with every result. Sequence numbers continue when a worker is replaced.
        on_event: called with a level (`info`, `warning`, `error`) and a line of text.
        on_preview: called with preview images, depth images and point clouds, while `watch` wants them.
        on_calibration: called when a worker is ready, with its camera's calibration or None.
        on_path: called with every planned path.
        record_as: name of the shared memory for processed frames, for a recorder; None: none.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        on_result: Callable[[PerceptionResult], None],
        on_event: Callable[[str, str], None],
        on_preview: Callable[[AnyPreview], None] = lambda _: None,
        on_calibration: Callable[[CameraCalibration | None], None] = lambda _: None,
        on_path: Callable[[PlannedPath], None] = lambda _: None,
        record_as: str | None = None,
    ) -> None:
        self._settings, self._record_as = settings, record_as
        self._on_path = on_path
        self._on_calibration = on_calibration
        self._on_preview = on_preview
        self._watched = Watched(False)
        self._on_result = on_result
        self._on_event = on_event
        self._state = PerceptionState.STOPPED
        self._task: asyncio.Task[None] | None = None
        self._stop_asked = asyncio.Event()
        self._killed = False
        self._process: PerceptionProcess | None = None
        self._watchdog: Watchdog | None = None
        self._input: StandardInput | None = None
        self._ready: Ready | None = None
        self._hud = Hud((), None)
        self._problem = ""
        self._restarts = 0
        self._pauses = Restarts()
        self._ready_s: float | None = None
        self._next_try_ns: int | None = None
        self._lost_s: float | None = None
        self._newest: PerceptionResult | None = None
        self._results = 0
        self._arrivals_s: deque[float] = deque()
        self._before, self._now = _Counts(), _Counts()
        self._times = StageTimes()
        self._first_sequence = 0
        self._tracks = LiveTracks()
        self._selecting: deque[asyncio.Future[Selected]] = deque()
        self._vehicle_limiter, self._gimbal_limiter = RateLimiter(), RateLimiter()
        self._path_limiter = RateLimiter()
        self._detecting: Detecting | None = None

    async def start(self) -> None:
        """Start the worker; returns when its model is loaded and its source has given a frame.

        A source that is not there, or any other failure that may pass, is tried again until then.

        Raises:
            PerceptionStartError: wrong settings: no such model or file, an unknown class, no such plug-in.
        """
        if self._task is not None:
            raise RuntimeError("a perception supervisor can be started only once; create another")
        self._state = PerceptionState.STARTING
        started: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._task = spawn(self._run(started), "perception supervisor")
        try:
            await asyncio.wait({started, self._task}, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            await self.stop()
            raise
        if not started.done():
            await self._task
            raise PerceptionStartError(self._problem)

    async def stop(self) -> None:
        """Stop the worker: by request (it finishes the video), then SIGTERM, then SIGKILL; in at most 7 s.

        An abnormal end is a warning: the video may be incomplete.
        """
        task = self._task
        if task is None or self._stop_asked.is_set():
            return
        self._stop_asked.set()
        if self._process is not None:
            self._process.ask_to_stop()
        await asyncio.wait({task}, timeout=STOP_S)
        if self._process is not None:
            self._process.terminate()
            await asyncio.wait({task}, timeout=TERMINATE_S)
        if self._process is not None:
            self._killed = True
            self._process.kill()
        await asyncio.wait({task})
        if self._input is not None:
            self._input.close()
        self._state = PerceptionState.STOPPED

    def send_hud(self, lines: Sequence[str], highlight: str | None = None) -> None:
        """Set the overlay of the recorded video.

        Args:
            lines: text of the panel.
            highlight: the class whose most confident detection is highlighted.
        """
        self._hud = Hud(tuple(lines), highlight)
        if self._process is not None and self._settings.recording.video is not None:
            self._process.send_hud(self._hud)

    def published(self, result: PerceptionResult) -> None:
        """Record the publication of a result: the duration of its last stage, since the inference."""
        self._times.add({"publish": (time.monotonic_ns() - result.inferred_ns) / 1e6})

    def watch(self, watched: bool, **others: bool) -> None:
        """Set whether preview images are wanted, and others of `Watched`; initially none."""
        wanted = replace(self._watched, watched=watched, **others)
        if wanted != self._watched:
            self._watched = wanted
            if self._process is not None:
                self._process.watch(wanted)

    def check_detecting(self, section: DetectorSection) -> None:
        """Raise ValueError if the loaded detector cannot have this confidence and these classes."""
        ready = self._ready
        if ready is None or ready.model is None:
            raise ValueError(f"detector.classes and confidence: no model is loaded ({self._state.value})")
        if section.confidence < ready.min_confidence:
            raise ValueError(
                f"detector.confidence: must be at least {ready.min_confidence:g}, for which the detector was "
                f"loaded, got {section.confidence:g}"
            )
        wanted = section.classes or range(len(ready.class_names))
        try:
            ids = resolve_classes(tuple(wanted), ready.class_names)
        except ValueError as error:
            raise ValueError(f"detector.classes: {error}") from None
        if ready.reportable_ids is not None and not set(ids) <= set(ready.reportable_ids):
            loaded = ", ".join(ready.class_names[index] for index in ready.reportable_ids)
            raise ValueError(
                f"detector.classes: the detector was loaded for {loaded} alone: for others set it in the "
                "file, and start the service again"
            )

    def change_detecting(self, section: DetectorSection) -> None:
        """Set confidence and classes, which were checked, for this worker and each later one."""
        self._detecting = Detecting(section.confidence, section.classes)
        if self._process is not None:
            self._process.change_detecting(self._detecting)

    async def select(self, request: SelectRequest) -> Selected:
        """Select an object in the worker's images, or end the selection. Never raises."""
        if self._process is None or self._state is not PerceptionState.RUNNING:
            return Selected(False, f"perception is not running ({self._state.value})")
        answer: asyncio.Future[Selected] = asyncio.get_running_loop().create_future()
        self._selecting.append(answer)
        self._process.select(request)
        await asyncio.wait({answer}, timeout=SELECT_TIMEOUT_S)
        if answer.done():
            return answer.result()
        answer.cancel()
        return Selected(False, f"no image was processed within {SELECT_TIMEOUT_S:g} s")

    def send_attitude(
        self,
        stamp_ns: int,
        attitude: Quaternion,
        height_m: float | None = None,
        position: tuple[int, Vector3] | None = None,
        *,
        in_flight: bool = False,
    ) -> None:
        """Send the vehicle's attitude, for tracker and obstacles; at most 50 a second. Never waits.

        Args:
            stamp_ns: CLOCK_MONOTONIC nanoseconds.
            attitude: (w, x, y, z), body FRD to NED.
            height_m: above home, None if unknown.
            position: its own stamp, and local NED metres.
            in_flight: whether it flies.
        """
        if self._needs_attitude and self._process is not None and self._vehicle_limiter.due(stamp_ns):
            self._process.send_attitude(Attitude(stamp_ns, attitude, height_m, position, in_flight))

    def request_path(self, request: PathRequest) -> None:
        """Send what path to plan; repeat it while it is wanted. Never waits."""
        if self._process is not None and self._path_limiter.due(time.monotonic_ns()):
            self._process.request_path(request)

    def send_gimbal(self, stamp_ns: int, attitude: Quaternion) -> None:
        """Send the gimbal's attitude, as `send_attitude`; (w, x, y, z), gimbal FRD to NED."""
        if self._needs_attitude and self._process is not None and self._gimbal_limiter.due(stamp_ns):
            self._process.send_attitude(GimbalAttitude(stamp_ns, attitude))

    @property
    def _needs_attitude(self) -> bool:
        # The tracker compensates the camera's rotation; ranges from depth need the direction of gravity.
        settings = self._settings
        return settings.detector.enabled or settings.guidance.obstacles != "off" or settings.recording.level

    @property
    def state(self) -> PerceptionState:
        """The current state."""
        return self._state

    @property
    def problem(self) -> str:
        """Why no worker runs: the last error; empty: one runs."""
        return self._problem

    @property
    def next_try_ns(self) -> int | None:
        """When a worker that has failed is started again, CLOCK_MONOTONIC; None: no pause."""
        return self._next_try_ns

    @property
    def ready(self) -> Ready | None:
        """What the newest worker has loaded; None before the start."""
        return self._ready

    @property
    def class_names(self) -> tuple[str, ...]:
        """Classes of the model, id → name; empty before the start and without a detector."""
        return () if self._ready is None else self._ready.class_names

    @property
    def status(self) -> PerceptionStatus:
        """A snapshot."""
        newest = self._newest
        return PerceptionStatus(
            state=self._state,
            pid=None if self._process is None else self._process.pid,
            restarts=self._restarts,
            frames=self._before.frames + self._now.frames,
            results=self._results,
            rate_hz=self._rate_hz(),
            newest=newest,
            age_s=None if newest is None else (time.monotonic_ns() - newest.captured_ns) / 1e9,
            timing_ms={} if newest is None else newest.timing_ms,
            timing_p50_ms=self._times.quantile_ms(0.5),
            timing_p99_ms=self._times.quantile_ms(0.99),
            dropped=self._before.dropped + self._now.dropped,
            frames_skipped=_sum(self._before.frames_skipped, self._now.frames_skipped),
            frames_repeated=_sum(self._before.frames_repeated, self._now.frames_repeated),
            stuck_after_s=None if self._watchdog is None else self._watchdog.stuck_after_s,
            class_names=self.class_names,
            runtime=None if self._ready is None else self._ready.runtime,
            runtime_reason="" if self._ready is None else self._ready.reason,
            tracks=len(self._tracks),
            problem=self._problem,
        )

    def _rate_hz(self) -> float:
        now_s = time.monotonic()
        while self._arrivals_s and now_s - self._arrivals_s[0] > _RATE_WINDOW_S:
            self._arrivals_s.popleft()
        if len(self._arrivals_s) < 2:
            return 0.0
        return (len(self._arrivals_s) - 1) / (now_s - self._arrivals_s[0])

    # --- successive workers

    async def _run(self, started: asyncio.Future[None]) -> None:
        while True:
            try:
                end = await self._run_one(started)
            except Exception as error:  # a fault of ours or of a callback: as that of a worker
                end = _End(False, error_text(error))
                if not self._problem.startswith(end.text):
                    logger.exception("the supervision of a worker has failed")
            if self._stop_asked.is_set():
                self._after_stop(end)
                return
            if end.finished:
                self._state = PerceptionState.FINISHED
                self._on_event("info", f"perception: {end.text}, after {self._before.frames} frames")
                return
            self._problem = with_load(end.text)
            if end.wrong_settings and not started.done():
                self._state = PerceptionState.FAILED
                return
            if self._input is not None and self._input.ended:
                self._state = PerceptionState.FAILED
                self._on_event("error", f"perception ended: {end.text}; standard input has no more frames")
                if not started.done():
                    started.set_result(None)
                return
            restart = self._after_death(end)
            self._state = PerceptionState.FAILED if restart.later else PerceptionState.RESTARTING
            self._next_try_ns = time.monotonic_ns() + round(restart.pause_s * 1e9)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(restart.pause_s):
                    await self._stop_asked.wait()
                return
            self._next_try_ns = None
            self._restarts += 1

    def _after_stop(self, end: _End) -> None:
        """Report a running worker that did not end normally."""
        if end.finished or self._state is not PerceptionState.RUNNING:
            return
        text = f"ended abnormally: {end.text}"
        if self._killed:
            text = f"did not end on request: {end.text}"
        if self._settings.recording.video is not None:
            text += f"; the video {self._worker_settings().recording.video} may be incomplete"
        self._on_event("warning", f"perception {text}")

    def _after_death(self, end: _End) -> Restart:
        """Report the loss; returns the next start."""
        now_s = time.monotonic()
        if self._ready is not None:
            self._lost_s = self._lost_s or now_s
        restart = self._pauses.after(0.0 if self._ready_s is None else now_s - self._ready_s, end.text)
        self._ready_s = None
        if restart.reported:
            lost = "not started" if self._ready is None else "lost"
            level = "error" if restart.later else "warning"
            self._on_event(level, f"perception {lost}: {end.text}; {restart}")
        return restart

    async def _run_one(self, started: asyncio.Future[None]) -> _End:
        """Start one worker and supervise it until its end."""
        try:
            process = await self._spawn()
        except OSError as error:
            return _End(False, f"perception process cannot be started: {error}")
        watchdog = Watchdog(time.monotonic(), self._settings.source.open_timeout_s)
        reading = asyncio.create_task(self._read(process, watchdog, started), name="perception reader")
        self._process, self._watchdog = process, watchdog
        try:
            if self._stop_asked.is_set():  # during the start
                process.ask_to_stop()
            stuck = await self._until_stuck(reading, watchdog)
            reported = None if stuck else reading.result()
            # A worker that has closed its end exits soon; a stuck one never does.
            if stuck or not await process.wait_ended(TERMINATE_S):
                process.kill()
            died = await process.wait()
            return stuck or reported or _End(False, died)
        finally:
            reading.cancel()
            process.kill()
            process.close()
            self._process = self._watchdog = None
            self._before.add(self._now)
            self._now = _Counts()
            self._selection_ended()
            self._first_sequence = 0 if self._newest is None else self._newest.sequence + 1

    async def _spawn(self) -> PerceptionProcess:
        settings, begin = self._worker_settings(), (self._tracks.next_id, self._record_as, self._detecting)
        if settings.source.uri != STANDARD_INPUT:
            return await PerceptionProcess.spawn(settings, asyncio.subprocess.DEVNULL, *begin)
        if self._input is None:
            self._input = StandardInput(settings.source)
        descriptor = self._input.for_worker()
        try:
            return await PerceptionProcess.spawn(settings, descriptor, *begin)
        finally:
            # The worker's copy must be the only one, else its death is not detected.
            os.close(descriptor)

    def _worker_settings(self) -> Settings:
        video = self._settings.recording.video
        if video is None or self._restarts == 0:
            return self._settings
        # The previous worker's video is kept; the next part gets a new name.
        path = Path(video)
        part = str(path.with_name(f"{path.stem}-{self._restarts + 1}{path.suffix}"))
        recording = self._settings.recording.model_copy(update={"video": part})
        return self._settings.model_copy(update={"recording": recording})

    async def _until_stuck(self, reading: asyncio.Task[_End | None], watchdog: Watchdog) -> _End | None:
        """Wait until the worker's messages end (None), or until it is silent for too long."""
        while True:
            before_s = time.monotonic()
            await asyncio.wait({reading}, timeout=_TICK_S)
            if reading.done():
                return None
            now_s = time.monotonic()
            if now_s - before_s > 4 * _TICK_S:
                # This loop was blocked; the worker's messages are still unread.
                watchdog.reset(now_s)
            # After the stop request it sends no messages, and `stop` has its own timeouts.
            elif not self._stop_asked.is_set() and watchdog.silent_s(now_s) > watchdog.stuck_after_s:
                assert self._process is not None
                text = f"process {self._process.pid} is stuck: no message for"
                return _End(False, f"{text} {watchdog.silent_s(now_s):.1f} s")

    async def _read(
        self, process: PerceptionProcess, watchdog: Watchdog, started: asyncio.Future[None]
    ) -> _End | None:
        """Process all messages; returns the end reported by the worker, None if it reported none."""
        while True:
            try:
                message = await process.read()
            except ProtocolError as error:
                return _End(False, str(error))
            if message is None:
                return None
            watchdog.on_message(time.monotonic())
            match message:
                case Report():
                    self._on_report(message)
                    watchdog.on_result(message.result.timing_ms.get("total", 0.0) / 1e3)
                case Ready():
                    watchdog.ready()
                    self._on_ready(message, process)
                    if not started.done():
                        started.set_result(None)
                case PlannedPath():
                    self._on_path(message)
                case Preview() | DepthPreview() | CloudPreview():
                    self._on_preview(replace(message, sequence=message.sequence + self._first_sequence))
                case StartFailed():
                    return _End(False, message.text, message.wrong_settings)
                case Ended():
                    self._now.frames = message.frames
                    return _End(message.finished, message.text)
                case _:
                    self._on_other(message)

    def _on_ready(self, ready: Ready, process: PerceptionProcess) -> None:
        self._ready = ready
        self._state, self._problem = PerceptionState.RUNNING, ""
        self._ready_s = time.monotonic()
        self._on_calibration(ready.calibration)
        self.send_hud(self._hud.lines, self._hud.highlight)
        process.watch(self._watched)
        if self._detecting is not None:  # set while the process was started
            process.change_detecting(self._detecting)
        if self._lost_s is not None:
            self._on_event("info", f"perception restored after {time.monotonic() - self._lost_s:.1f} s")
            self._lost_s = None
            return
        model = "no detector"
        if ready.model is not None:
            model = f"model {ready.model} with {len(ready.class_names)} classes"
            model += f" by {ready.runtime}" if ready.runtime else ""
            model += f" in {ready.precision}" if ready.precision else ""
        self._on_event("info", f"perception running: {ready.source}, {model} (process {process.pid})")

    def _on_report(self, report: Report) -> None:
        result = self._tracks.update(
            replace(report.result, sequence=report.result.sequence + self._first_sequence)
        )
        self._count(report.frames, result.dropped, result.frames_skipped, report.replaced)
        self._now.frames_repeated = dict(result.frames_repeated)
        result = replace(result, dropped=self._before.dropped + self._now.dropped)
        for event in result.track_events:
            if event.kind is TrackEventKind.END and event.track.class_name == TARGET_CLASS:
                self._on_event("info", f"track {event.track.track_id}, the selected object, has ended")
        self._newest = result
        self._results += 1
        self._arrivals_s.append(time.monotonic())
        self._rate_hz()
        self._times.add(result.timing_ms)
        self._on_result(result)

    def _count(self, frames: int, dropped: int, frames_skipped: Mapping[str, int], superseded: int) -> None:
        """Set the counts of the current worker."""
        skipped = {**frames_skipped, "superseded": superseded}
        self._now = _Counts(frames, dropped + superseded, skipped, self._now.frames_repeated)

    def _selection_ended(self) -> None:
        """The worker has ended: its selected object is lost, and its pending selections have failed."""
        for track in self._tracks.worker_ended():
            if track.class_name == TARGET_CLASS:
                text = f"track {track.track_id}, the selected object, is lost with the perception process"
                self._on_event("warning", f"{text}: select it again")
        while self._selecting:
            self._answer_selection(Selected(False, "the perception process has ended; select again"))

    def _answer_selection(self, answer: Selected) -> None:
        """Answer the oldest request; one that has timed out is only removed."""
        waiting = self._selecting.popleft() if self._selecting else None
        if waiting is not None and not waiting.done():
            waiting.set_result(answer)

    def _on_other(self, message: Message) -> None:
        if isinstance(message, Selected):
            self._answer_selection(message)
        elif isinstance(message, Heartbeat):
            superseded = self._now.frames_skipped.get("superseded", 0)
            self._count(message.frames, message.dropped, message.frames_skipped, superseded)
        elif isinstance(message, LogLine):
            # Warnings and errors become events, the rest is only logged. Never both.
            if message.level >= logging.WARNING:
                level = "error" if message.level >= logging.ERROR else "warning"
                self._on_event(level, message.text)
            else:
                logging.getLogger(message.logger).log(message.level, "%s", message.text)


def _sum(one: dict[str, int], other: dict[str, int]) -> dict[str, int]:
    return {reason: one.get(reason, 0) + other.get(reason, 0) for reason in {**one, **other}}
