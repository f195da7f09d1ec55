"""Records a flight in lockstep: the same records as the service's, written directly."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from companion.bench.lockstep_flight import LockstepFlight
from companion.guidance.interface import GuidanceInput, GuidanceOutput
from companion.recording.convert import ANY_OBJECT, INPUT_CHANNEL, OUTPUT_CHANNEL, RUN_CHANNEL
from companion.recording.encoding import dumps
from companion.recording.files import Channel, Recorded, RecordingReader, RecordingWriter
from companion.recording.guidance_record import input_record, output_record
from companion.recording.tap import run_record

GIGABYTE = 10**9


def new_writer(folder: Path, **limits: float) -> RecordingWriter:
    """A writer of large files, unless limited."""
    chosen = {"max_bytes": GIGABYTE, "max_duration_s": 3600.0, "max_total_bytes": GIGABYTE} | limits
    return RecordingWriter(folder, "vehicle1", **chosen)  # type: ignore[arg-type]


@contextmanager
def recording(flight: LockstepFlight, folder: Path) -> Iterator[Path]:
    """Record every step of guidance meanwhile; yields the file, which is complete afterwards."""
    writer, original = new_writer(folder), flight.guidance.step
    run = run_record(flight.settings, flight.guidance.options, (1, 191), "service1")
    writer.write(Channel(RUN_CHANNEL, "companion.run", ANY_OBJECT), flight.now_ns, dumps(run))
    number = 0

    def step(now_ns: int, inputs: GuidanceInput) -> GuidanceOutput:
        nonlocal number
        taken = input_record(number, now_ns, flight.guidance.gimbal.mounting, inputs)
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
        writer.close()


def rewritten(path: Path, folder: Path, change: Callable[[Recorded], Recorded | None]) -> Path:
    """Copy a recording; `change` returns a message's replacement, or None to leave it out."""
    writer = new_writer(folder)
    for message in RecordingReader(path).messages():
        if (other := change(message)) is not None:
            writer.write(*other)
    writer.close()
    return writer.path
