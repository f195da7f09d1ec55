"""Records a flight in lockstep: the same records as the service's, written directly."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader

from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.bus.messages import ModelIdentity, depth_image_attachment, detections_message
from companion.bus.topics import DEPTH_IMAGE, DETECTIONS, IMAGE, RUN, Topic
from companion.guidance.interface import GuidanceInput, GuidanceOutput
from companion.recording.convert import ANY_OBJECT, INPUT_CHANNEL, OUTPUT_CHANNEL, RUN_CHANNEL, Converter
from companion.recording.encoding import dumps
from companion.recording.files import Channel, Recorded, RecordingReader, RecordingWriter
from companion.recording.guidance_record import input_record, output_record
from companion.recording.tap import run_record
from vision.depth import depth_millimetres
from vision.frame import Frame
from vision.pipeline import PerceptionResult

GIGABYTE = 10**9


def new_writer(folder: Path, **limits: float) -> RecordingWriter:
    """A writer of large files, unless limited."""
    chosen = {"max_bytes": GIGABYTE, "max_duration_s": 3600.0, "max_total_bytes": GIGABYTE} | limits
    return RecordingWriter(folder, "vehicle1", **chosen)  # type: ignore[arg-type]


def library_times(path: Path) -> list[int]:
    """The log times that the mcap library reads of a file without an end, in the order of writing."""
    found: list[int] = []
    with path.open("rb") as file, suppress(EndOfFile, struct.error):
        for _, _, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            found.append(message.log_time)
    return found


@contextmanager
def recording(
    flight: LockstepFlight, folder: Path, *, images: str = "", model: ModelIdentity | None = None
) -> Iterator[Path]:
    """Record every step of guidance meanwhile; yields the file, which is complete afterwards.

    Args:
        images: `.png` or `.jpg`: also the rendered camera's images, depth and detections. model: its model.
    """
    writer, original = new_writer(folder), flight.guidance.step
    run = run_record(flight.settings, flight.guidance.options, "service1")
    writer.write(Channel(RUN_CHANNEL, "companion.run", ANY_OBJECT), flight.now_ns, dumps(run))
    converter = Converter("vehicle1")
    list(converter.convert(RUN.name, dumps(run)))
    number = 0

    def write(topic: Topic, payload: bytes, attachment: bytes | None = None) -> None:
        for message in converter.convert(topic.name, payload, attachment):
            writer.write(*message)

    def process(frame: Frame, now_ns: int) -> PerceptionResult | None:
        result = detect(frame, now_ns)
        assert result is not None
        _, encoded = cv2.imencode(images, frame.image)
        stamps = {"captured_ns": frame.captured_ns}
        write(IMAGE, encoded.tobytes(), json.dumps(stamps).encode())
        if frame.depth_m is not None:
            about = depth_image_attachment(frame.sequence, frame.captured_ns, None, frame.width, frame.height)
            write(DEPTH_IMAGE, zlib.compress(depth_millimetres(frame.depth_m).tobytes()), dumps(about))
        write(DETECTIONS, dumps(detections_message(result, "vehicle1", now_ns, model=model)))
        return result

    camera = flight.cameras[0] if images else None
    if isinstance(camera, RenderedCamera):
        detect = camera.perception.process
        camera.perception.process = process  # type: ignore[method-assign]

    def step(now_ns: int, inputs: GuidanceInput) -> GuidanceOutput:
        nonlocal number
        context = flight.inputs.step_context(flight.guidance.gimbal.mounting)
        taken = input_record(number, now_ns, context, inputs)
        output = original(now_ns, inputs)
        given = output_record(number, now_ns, output)
        writer.write(Channel(INPUT_CHANNEL, "companion.guidance_input", ANY_OBJECT), now_ns, dumps(taken))
        writer.write(Channel(OUTPUT_CHANNEL, "companion.guidance_output", ANY_OBJECT), now_ns, dumps(given))
        number += 1
        return output

    flight.guidance.step = step  # type: ignore[method-assign]
    try:
        yield writer.path
    finally:
        flight.guidance.step = original  # type: ignore[method-assign]
        if isinstance(camera, RenderedCamera):
            camera.perception.process = detect  # type: ignore[method-assign]
        writer.close()


def rewritten(path: Path, folder: Path, change: Callable[[Recorded], Recorded | None]) -> Path:
    """Copy a recording; `change` returns a message's replacement, or None to leave it out."""
    writer = new_writer(folder)
    for message in RecordingReader(path).messages():
        if (other := change(message)) is not None:
            writer.write(*other)
    writer.close()
    return writer.path
