"""The service's side of a recording: what only this process has, for a recorder in another one.

The loop only appends frozen values to bounded queues, of which the oldest are dropped. A thread encodes and
publishes them, while a recorder listens: steps of guidance, and the bytes on the autopilot's link.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

from companion.bus.session import Bus
from companion.bus.topics import GUIDANCE_INPUT, GUIDANCE_OUTPUT, MAVLINK, RUN
from companion.guidance.core import GuidanceOptions
from companion.guidance.interface import GuidanceInput, GuidanceOutput
from companion.host.clock import unix_offset_ns
from companion.recording.encoding import dumps, encode
from companion.recording.guidance_record import LAYOUT, StepContext, input_record, output_record
from companion.recording.link_bytes import LinkBytes, pack_link_bytes
from companion.settings import Settings
from companion.settings.perception import NO_SOURCE

logger = logging.getLogger(__name__)

# Some ten seconds of either: a recorder that was just started needs one to three to listen.
MAX_STEPS, MAX_PIECES = 1000, 10_000
PERIOD_S = 0.05
_RUN_PERIOD_S = 1.0
# How long steps and bytes are kept for the recorder that the service starts itself, and starts again.
_RECORDER_STARTS_S = 15.0


def run_record(settings: Settings, options: GuidanceOptions, service: str) -> dict[str, Any]:
    """Describe this run of the service, as JSON-able data: what a replay needs besides the inputs.

    Of the settings it has no address, file of a key or source.
    """
    sections = {"camera", "detector", "tracker"}
    kept: dict[str, Any] = {"vehicle": {"name"}, "guidance": True, "preview": True}
    kept |= {**dict.fromkeys(sections, True), "cameras": dict.fromkeys(settings.cameras, sections)}
    values = settings.model_dump(mode="json", include=kept)
    # A device may be given once only, and by default it is.
    for camera in (values, *values["cameras"].values()):
        camera["source"] = {"uri": NO_SOURCE}
    return {
        "layout": LAYOUT,
        "version": version("mavlink-companion"),
        "vehicle": settings.vehicle.name,
        "service": service,
        "unix_offset_ns": unix_offset_ns(),
        "options": encode(GuidanceOptions, options),
        "settings": values,
    }


class FlightTap:
    """Publishes `RECORDER_TOPICS`.

    Args:
        run: of `run_record`.
        expected: the service starts a recorder itself, so steps and bytes wait for it.
    """

    def __init__(self, bus: Bus, run: dict[str, Any], *, expected: bool) -> None:
        self._bus, self._run = bus, dumps(run)
        self._steps: deque[tuple[int, int, StepContext, GuidanceInput, GuidanceOutput]] = deque(
            maxlen=MAX_STEPS
        )
        self._pieces: deque[tuple[int, LinkBytes]] = deque(maxlen=MAX_PIECES)
        self._step = self._piece = 0
        self._wait_s = _RECORDER_STARTS_S if expected else 0.0
        self._wait_until_s = time.monotonic() + self._wait_s
        self._run_due_s = 0.0
        self._failed = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._publish_until_closed, name="flight tap", daemon=True)

    def start(self) -> None:
        """Start publishing."""
        self._thread.start()

    def close(self) -> None:
        """Publish what is queued and end; bounded in time. Can be called without `start`."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join(2.0)

    def on_step(
        self, now_ns: int, context: StepContext, inputs: GuidanceInput, output: GuidanceOutput
    ) -> None:
        """Queue one step of guidance."""
        self._steps.append((self._step, now_ns, context, inputs, output))
        self._step += 1

    def on_bytes(self, sent: bool, data: bytes) -> None:
        """Queue bytes of the autopilot's link."""
        self._pieces.append((self._piece, LinkBytes(time.monotonic_ns(), sent, data)))
        self._piece += 1

    def _publish_until_closed(self) -> None:
        while not self._closing.wait(PERIOD_S):
            self._try_to_publish()
        self._try_to_publish()

    def _try_to_publish(self) -> None:
        try:
            self._publish()
        except Exception:
            if not self._failed:
                logger.exception("steps and bytes cannot be recorded (logged once)")
            self._failed = True

    def _publish(self) -> None:
        if not self._bus.watched(RUN):
            self._run_due_s = 0.0
        elif time.monotonic() >= self._run_due_s:
            self._run_due_s = time.monotonic() + _RUN_PERIOD_S
            self._bus.publish(RUN, self._run)
        # A recorder subscribes to this topic last.
        if not self._bus.watched(MAVLINK):
            if time.monotonic() > self._wait_until_s:
                self._steps.clear()
                self._pieces.clear()
            return
        self._wait_until_s = time.monotonic() + self._wait_s
        for _ in range(len(self._steps)):
            self._publish_step(*self._steps.popleft())
            time.sleep(0)  # the loop's thread goes first
        pieces = [self._pieces.popleft() for _ in range(len(self._pieces))]
        for begin, end in _runs([number for number, _ in pieces]):
            batch = [piece for _, piece in pieces[begin:end]]
            self._bus.publish(MAVLINK, pack_link_bytes(pieces[begin][0], batch))

    def _publish_step(
        self, step: int, now_ns: int, context: StepContext, inputs: GuidanceInput, output: GuidanceOutput
    ) -> None:
        try:
            taken = dumps(input_record(step, now_ns, context, inputs))
            given = dumps(output_record(step, now_ns, output))
        except Exception:
            # Such as a value of another type in a plug-in's outcome. The missing step shows in the recording.
            if not self._failed:
                logger.exception("step %d of guidance cannot be recorded (logged once)", step)
            self._failed = True
            return
        self._bus.publish(GUIDANCE_INPUT, taken)
        self._bus.publish(GUIDANCE_OUTPUT, given)


def _runs(numbers: list[int]) -> Iterator[tuple[int, int]]:
    """(begin, end) of each part of a list without a gap, at most 256 long."""
    begin = 0
    for end in range(1, len(numbers) + 1):
        if end == len(numbers) or numbers[end] != numbers[end - 1] + 1 or end - begin == 256:
            yield begin, end
            begin = end
