"""The perception worker: the process that reads and processes frames. `process.py` starts it.

It gets two sockets, one for its reports and one for control messages, and exits when their other ends close:
without the service its results are useless, and a camera can have only one owner.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from companion.host.scheduling import lower_priority, run_when_idle
from companion.perception.assembly import (
    CameraTelemetry,
    build_levelling,
    build_path_planning,
    build_pipeline,
    change_detecting,
    load_detector,
)
from companion.perception.messages import (
    Attitude,
    Begin,
    Detecting,
    Ended,
    GimbalAttitude,
    Heartbeat,
    Hud,
    Message,
    Ready,
    Report,
    ResultLogHandler,
    ResultSender,
    StartFailed,
    Stop,
    Watched,
    receive,
)
from companion.perception.previews import CloudEncoder, PreviewEncoder
from companion.perception.standard_input import STANDARD_INPUT
from companion.settings import Settings
from companion.settings.calibration import adopt_calibration
from companion.settings.plugins import PluginError, load_plugins
from vision.detections import Detections
from vision.frame import Frame
from vision.model_files import find_model
from vision.object_detector import YOLO, DetectionsError, ObjectDetector
from vision.path_planner import PathRequest
from vision.pipeline import PerceptionResult, Pipeline
from vision.recording import Recording
from vision.redaction import print_traceback, redacted
from vision.runtimes.exported import kind_of
from vision.sources import EndOfStream, Source, SourceError, SourceUnavailableError, check_there, open_source
from vision.sources.shared import FrameSharing
from vision.sources.source import NoFrameError
from vision.tracking import Selected, SelectRequest
from vision.video_writer import VideoWriterError

logger = logging.getLogger("companion.perception.worker")  # `__main__` in the process itself

# Maximum interval of the loop's messages.
HEARTBEAT_S = 0.25
# Time limits of the last messages, and of the shutdown after the service has gone.
CLOSE_TIMEOUT_S = 2.0
_LOADING_PERIOD_S = 2.0
GRACE_S = 5.0
# The service's guidance loop has priority on a shared core.
NICENESS = 5
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class ControlChannel:
    """The service's control messages, received by a thread.

    Attributes:
        stopping: end now. asked: the service has asked for it.
        hud: overlay of the recorded video's next frames.
        telemetry: of the vehicle.
        watched: which previews are wanted.
        selections: what to select, oldest first; the reader removes them.
        path_request: the newest, and when it was received.
        detecting: what to detect from the next frame on; None: unchanged. The reader removes it.
    """

    def __init__(self, connection: socket.socket) -> None:
        self.stopping = self.asked = False
        self.hud = Hud((), None)
        self.watched = Watched(False)
        self.selections: deque[SelectRequest] = deque()
        self.path_request: tuple[PathRequest, int] | None = None
        self.detecting: Detecting | None = None
        self.telemetry = CameraTelemetry()
        self._connection = connection
        self._finished = threading.Event()
        threading.Thread(target=self._receive, name="control", daemon=True).start()

    def stop(self) -> None:
        """End now. Takes no lock: a second signal may come while the first is handled in the same thread."""
        self.stopping = True

    def finished(self) -> None:
        """Note that the work has ended in time."""
        self._finished.set()

    def _receive(self) -> None:
        try:
            while (message := receive(self._connection)) is not None:
                self._take(message)
        finally:
            # The service is gone, or this has failed: without attitudes and requests the worker is replaced.
            # A thread still blocked in a driver after the grace time never returns.
            self.stop()
            if not self._finished.wait(GRACE_S):
                os._exit(1)

    def _take(self, message: Message) -> None:
        if isinstance(message, Hud):
            self.hud = message
        elif isinstance(message, Attitude):
            self.telemetry.attitudes.add(message.stamp_ns, message.wxyz)
            self.telemetry.height_m = message.height_m
            self.telemetry.in_flight = message.in_flight
            if message.position is not None:
                self.telemetry.positions.add(*message.position)
        elif isinstance(message, GimbalAttitude):
            self.telemetry.gimbal.add(message.stamp_ns, message.wxyz)
        elif isinstance(message, Watched):
            self.watched = message
        elif isinstance(message, PathRequest):
            self.path_request = (message, time.monotonic_ns())
        elif isinstance(message, Detecting):
            self.detecting = message
        elif isinstance(message, SelectRequest):
            self.selections.append(message)
        elif isinstance(message, Stop):
            self.asked = True
            self.stop()


class ProcessedFrames:
    """Gives a recorder the processed frames in shared memory, numbered without gaps.

    Args:
        depth: with their depth.

    Attributes:
        newest_ns: capture of the frame that was processed last; set by the owner.
    """

    def __init__(self, name: str, *, depth: bool) -> None:
        self.newest_ns = -1
        self._depth = depth
        self._sharing: FrameSharing | None = FrameSharing(name)
        self._count = 0

    def write(self, frame: Frame) -> None:
        """Give a frame, if it was processed; a failure ends the recording of images only."""
        if self._sharing is None or frame.captured_ns != self.newest_ns:
            return
        try:
            depth_m = frame.depth_m if self._depth else None
            self._sharing.write(replace(frame, depth_m=depth_m, sequence=self._count))
            self._count += 1
        except SourceError as error:
            logger.warning("images are not recorded: %s", error)
            self.close()

    def close(self) -> None:
        """Remove the shared memory."""
        if self._sharing is not None:
            self._sharing.close()
        self._sharing = None


@dataclass(frozen=True, slots=True)
class Perception:
    """The opened parts of the worker."""

    source: Source
    detector: ObjectDetector | None
    recording: Recording | None
    preview: PreviewEncoder
    clouds: CloudEncoder
    processed: ProcessedFrames | None = None
    plan: Callable[[Frame], None] = lambda frame: None

    def write(self, frame: Frame, detections: Detections) -> None:
        """Pass a frame, after its result was sent, to path planning, recording and previews."""
        self.plan(frame)
        if self.processed is not None:
            self.processed.write(frame)
        if self.recording is not None:
            self.recording.write(frame, detections)
        self.preview.write(frame, detections)
        self.clouds.write(frame, detections)


def main(arguments: list[str]) -> int:
    """Run until the source ends, the service ends, or a stop is requested.

    Args:
        arguments: the descriptors of the report and control sockets, and the service's process id.
    """
    reports, control_fd, service_pid = (int(argument) for argument in arguments)
    _end_with(service_pid)
    lower_priority(NICENESS)
    connection = socket.socket(fileno=control_fd)
    begin = receive(connection)
    if not isinstance(begin, Begin):
        return 1
    if begin.settings.detector.priority == "idle":
        run_when_idle()
    control = ControlChannel(connection)
    signal.signal(signal.SIGTERM, lambda _signal, _frame: control.stop())
    sender = ResultSender(socket.socket(fileno=reports), on_lost=control.stop)
    logging.basicConfig(level=begin.settings.log.level.upper(), handlers=[ResultLogHandler(sender)])
    last = _work(begin, control, sender)
    sender.close(last, CLOSE_TIMEOUT_S)
    control.finished()
    return 0 if isinstance(last, Ended) and last.finished else 1


def _end_with(service_pid: int) -> None:
    """Let the kernel send SIGTERM when the service dies; what a terminal sends to all is for the service."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != service_pid:  # it died before prctl
        os._exit(1)


def _work(begin: Begin, control: ControlChannel, sender: ResultSender) -> Ended | StartFailed:
    settings = begin.settings
    frames = 0
    with contextlib.ExitStack() as stack:
        try:
            with _heartbeat_while_loading(settings, sender):
                perception = _open(begin, stack, sender)
                if perception.source.calibration is not None:
                    adopted = adopt_calibration(settings.camera, perception.source.calibration).camera
                    settings = settings.model_copy(update={"camera": adopted})
                    perception.clouds.camera = adopted
        except NoFrameError as error:
            # Of standard input the program that should write to it has failed, not our settings.
            return StartFailed(_one_line(error), wrong_settings=settings.source.uri != STANDARD_INPUT)
        except (SourceUnavailableError, MemoryError) as error:
            return StartFailed(_one_line(error) or type(error).__name__, wrong_settings=False)
        except (PluginError, SourceError, VideoWriterError, ValueError) as error:  # with CheckpointError
            return StartFailed(_one_line(error), wrong_settings=True)
        except OSError as error:
            wrong = isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError)
            return StartFailed(_one_line(error), wrong_settings=wrong)
        except Exception as error:  # a bug: the traceback goes to standard error
            print_traceback()
            text = f"perception cannot start: {type(error).__name__}: {_one_line(error)}"
            return StartFailed(text, wrong_settings=False)
        # Loaded objects stay: scanning them would cost the garbage collector the time of a frame.
        gc.collect()
        gc.freeze()
        sender.put(_ready(perception))
        perception = replace(perception, plan=_planner(settings, control, sender))
        if perception.recording is not None and settings.recording.level:
            perception.recording.level = build_levelling(settings, control.telemetry)
        pipeline = build_pipeline(
            settings,
            perception.source,
            perception.detector,
            control.telemetry,
            recorder=perception,
            first_track_id=begin.first_track_id,
        )
        control.detecting = control.detecting or begin.detecting
        try:
            _run(settings, pipeline, perception, control, sender)
        except EndOfStream:
            return Ended(True, "end of stream", pipeline.frames)
        except (SourceError, DetectionsError) as error:
            return Ended(False, _one_line(error), pipeline.frames)
        except Exception as error:
            print_traceback()
            return Ended(False, f"{type(error).__name__}: {_one_line(error)}", pipeline.frames)
        frames = pipeline.frames
    text = "stop requested" if control.asked else "stopped by a signal, or without the service's messages"
    return Ended(control.asked, text, frames)


@contextlib.contextmanager
def _heartbeat_while_loading(settings: Settings, sender: ResultSender) -> Iterator[None]:
    """Send heartbeats while loading: converting a model and selecting a runtime may take minutes.

    The loading time of a plug-in's detector is unknown.
    """
    loaded = threading.Event()

    def send_heartbeats() -> None:
        while not loaded.wait(_LOADING_PERIOD_S):
            sender.put_newest(Heartbeat(0))

    section = settings.detector
    default = "torch" if kind_of(find_model(section.model)) is None else None
    if (section.runtime or default) != "torch" or section.kind != YOLO or settings.plugins.modules:
        threading.Thread(target=send_heartbeats, name="loading", daemon=True).start()
    try:
        yield
    finally:
        loaded.set()


def _open(begin: Begin, stack: contextlib.ExitStack, sender: ResultSender) -> Perception:
    settings = begin.settings
    load_plugins(settings.plugins.modules)
    recording = None
    if settings.recording.video is not None:
        recording = Recording(settings.recording.video, settings.recording.rate_hz)
        stack.callback(recording.close)
    check_there(settings.source.uri)  # before a model is loaded, for every try again
    detector = load_detector(settings) if settings.detector.enabled else None
    share = None
    if settings.source.share is not None:
        share = stack.enter_context(FrameSharing(settings.source.share)).write

    def on_frame(frame: Frame) -> None:
        try:
            settings.camera.model(frame.width, frame.height)
        except ValueError as error:
            raise SourceError(f"camera: {error}") from error
        if share is not None:
            share(frame)

    source = stack.enter_context(open_source(settings.source.uri, settings.source.opening(on_frame)))
    if recording is not None:
        # Again, to finish it before the source closes, which may be slow in a driver.
        stack.callback(recording.close)
    preview = PreviewEncoder(settings.preview, sender.put_preview)
    stack.callback(preview.close)
    clouds = CloudEncoder(settings.preview, settings.camera, sender.put_preview)
    stack.callback(clouds.close)
    processed = None
    if begin.record_as is not None:
        processed = ProcessedFrames(begin.record_as, depth="depth" in settings.recording.content)
        stack.callback(processed.close)
    return Perception(source, detector, recording, preview, clouds, processed)


def _planner(settings: Settings, control: ControlChannel, sender: ResultSender) -> Callable[[Frame], None]:
    """Return a function that adds a frame to the map and sends the path that is requested."""
    planning = build_path_planning(settings, control.telemetry)

    def plan(frame: Frame) -> None:
        if planning is None:
            return
        if control.path_request is not None:
            planning.request(*control.path_request)
        if (planned := planning.update(frame, time.monotonic_ns())) is not None:
            sender.put(planned)

    return plan


def _ready(perception: Perception) -> Ready:
    detector, calibration = perception.detector, perception.source.calibration
    if detector is None:
        return Ready(perception.source.uri, None, (), None, calibration=calibration)
    return Ready(
        perception.source.uri,
        detector.model_name,
        detector.class_names,
        detector.precision,
        detector.runtime,
        detector.reason,
        calibration,
        detector.model_sha256,
        detector.rendered_only,
        detector.min_confidence,
        detector.reportable_ids,
    )


def _run(
    settings: Settings,
    pipeline: Pipeline,
    perception: Perception,
    control: ControlChannel,
    sender: ResultSender,
) -> None:
    sent_s = time.monotonic()
    selection = pipeline.object_selection

    def deliver(result: PerceptionResult) -> None:
        nonlocal sent_s
        if perception.processed is not None:
            perception.processed.newest_ns = result.captured_ns
        sender.put_newest(Report(result, pipeline.frames, replaced=0))
        for answer in () if selection is None else selection.take_answers():
            sender.put(answer)
        sent_s = time.monotonic()

    while not control.stopping:
        if perception.recording is not None:
            perception.recording.lines = control.hud.lines
            perception.recording.highlight = control.hud.highlight
        watched = control.watched
        perception.preview.watched, perception.clouds.watched = watched.watched, watched.clouds
        perception.preview.depth = watched.depth
        while control.selections:
            request = control.selections.popleft()
            if selection is None:
                why = "select needs tracks: set detector.enabled and tracker.enabled of this camera"
                sender.put(Selected(False, why))
            else:
                selection.request(request)
        detecting, control.detecting = control.detecting, None
        if detecting is not None and perception.detector is not None:
            change_detecting(settings, detecting, perception.detector, pipeline.tracker)
        pipeline.step(HEARTBEAT_S, deliver)
        if time.monotonic() - sent_s >= HEARTBEAT_S:
            sender.put_newest(Heartbeat(pipeline.frames, pipeline.dropped, pipeline.frames_skipped))
            sent_s = time.monotonic()


def _one_line(error: BaseException) -> str:
    return redacted(" ".join(str(error).split()))


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stderr.flush()
    # Skip the interpreter's shutdown: a thread that is still in a driver would block or crash it.
    os._exit(code)
