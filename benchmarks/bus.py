"""The bus under load, measured on this machine: time from put to a subscriber in another process.

    python -m benchmarks.bus --seconds 10 --rate-hz 30
    python -m benchmarks.bus --recovered 100000

Detectors use every core beside it. A recovered topic is one whose lost messages zenoh sends again.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import socket
import tempfile
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from subprocess import DEVNULL
from typing import Any, Literal, get_args

import cv2
import numpy as np
import zenoh

from companion.bench.percentiles import percentiles
from companion.bus import topics
from companion.bus.bodies.frames import DetectionBody, DetectionsBody, ObjectBody
from companion.bus.client import client_settings, open_client, subscribe_kept
from companion.bus.session import Bus, BusError, encode
from companion.host.peer_data import copy_payload, parse_object
from companion.host.scheduling import schedule_as_any_program, set_scheduler_slice
from companion.perception.messages import Report, StartFailed
from companion.perception.process import PerceptionProcess
from companion.settings import Settings, ZenohSection
from mavlink_sim.datasets.training_scenes import random_scene
from mavlink_sim.testing import free_port

Priority = Literal["low", "idle"]

VEHICLE = "bench"
# Ten detections with every field: 6 kB of JSON.
DETECTIONS = 10
# A burst is half of what is kept, so that every message of it can be recovered.
BURST = topics.EVENTS.cached // 2
# A lost message at the end of a burst is noticed by the next heartbeat, one second later.
RECOVERY_S = 10.0
_START_S = 30.0
# A worker that uses another runtime than torch may convert the model first.
_LOADING_S = 120.0
# A rendered image with seven objects of five classes.
_SCENE_SEED = 1
_WARM_UP_MESSAGES = 20
_WARM_UP = -1


def measure_bus(seconds: float, *, rate_hz: float, load: int, priority: Priority = "low") -> dict[str, Any]:
    """Time messages of ten detections from this process to a subscriber with default priority in another one.

    This process has the priority of the service. `put_to_subscriber` is from immediately before the message
    is given to zenoh until the subscriber's callback has it; `build_and_encode` precedes it.

    Args:
        rate_hz: of the messages. One that is late delays the next ones: the result has the achieved rate.
        load: number of perception workers beside it: the bundled model, one thread each, no pause.
        priority: of the workers (`detector.priority`).

    Raises:
        RuntimeError: the subscriber or a worker does not start.
    """
    return asyncio.run(_measure_bus(seconds, rate_hz, load, priority))


async def _measure_bus(seconds: float, rate_hz: float, load: int, priority: Priority) -> dict[str, Any]:
    build_ns: list[int] = []
    put_ns: list[int] = []
    async with _detecting(load, priority) as frames, _Reader(_read_detections) as reader:
        set_scheduler_slice()  # as the service
        await _until_watched(reader.bus)
        before, started_s = sum(frames), time.monotonic()
        due_s = started_s
        for sequence in range(-_WARM_UP_MESSAGES, round(seconds * rate_hz)):
            due_s = max(due_s + 1 / rate_hz, time.monotonic())
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            called_ns = time.monotonic_ns()
            message = encode(_detections(sequence))
            built_ns = time.monotonic_ns()
            reader.bus.publish(topics.DETECTIONS, message)
            if sequence >= 0:
                build_ns.append(built_ns - called_ns)
                put_ns.append(built_ns)
        elapsed_s = time.monotonic() - started_s
        detected = sum(frames) - before
        await asyncio.sleep(0.5)
        received = await reader.result()
    delays_ms = [(received_ns - put_ns[sequence]) / 1e6 for sequence, received_ns in received["times"]]
    if not delays_ms:
        raise RuntimeError(f"none of {len(put_ns)} messages has reached the subscriber's process")
    return {
        "rate_hz": round((_WARM_UP_MESSAGES + len(put_ns)) / elapsed_s, 1),
        "cores": len(os.sched_getaffinity(0)),
        "detectors": load,
        "detector_frames_per_s": round(detected / elapsed_s, 1),
        "message_bytes": len(message),
        "published": len(put_ns),
        "received": len(delays_ms),
        "build_and_encode_p50_ms": percentiles([value / 1e6 for value in build_ns])["p50_ms"],
        **{f"put_to_subscriber_{name}": value for name, value in percentiles(delays_ms).items()},
    }


@asynccontextmanager
async def _detecting(number: int, priority: Priority) -> AsyncIterator[list[int]]:
    """Run perception workers, each on one thread and without a pause; yields their numbers of frames."""
    frames = [0] * number
    workers: list[PerceptionProcess] = []
    reading: list[asyncio.Task[None]] = []
    with tempfile.TemporaryDirectory() as folder:
        image = Path(folder, "frame.png")
        cv2.imwrite(str(image), random_scene(np.random.default_rng(_SCENE_SEED), 640, 480)[0])
        settings = Settings.model_validate(
            {
                "source": {"uri": str(image), "loop": True, "every_frame": True},
                # The size of `companion play`.
                "detector": {"threads": 1, "image_size": 320, "priority": priority},
            }
        )

        async def read(index: int) -> None:
            reason = "its process has ended"
            while (message := await workers[index].read()) is not None:
                if isinstance(message, Report):
                    frames[index] = message.frames
                elif isinstance(message, StartFailed):
                    reason = message.text
            raise RuntimeError(f"no perception worker: {reason}")

        def check() -> None:
            for task in reading:
                if task.done():
                    task.result()

        try:
            for index in range(number):
                workers.append(await PerceptionProcess.spawn(settings, DEVNULL))
                reading.append(asyncio.create_task(read(index)))
            deadline_s = time.monotonic() + _LOADING_S
            while not all(frames):
                check()
                if time.monotonic() > deadline_s:
                    raise RuntimeError(f"no result of a perception worker within {_LOADING_S:g} s")
                await asyncio.sleep(0.05)
            yield frames
            check()
        finally:
            for worker in workers:
                worker.kill()
            for worker, task in zip(workers, reading, strict=True):
                await worker.wait()
                await asyncio.gather(task, return_exceptions=True)


async def _until_watched(bus: Bus) -> None:
    async with asyncio.timeout(_START_S):
        while not bus.watched(topics.DETECTIONS):  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.01)


def measure_recovery(messages: int) -> dict[str, Any]:
    """Publish on a topic with kept messages; count what an advanced subscriber in another process misses.

    Bursts of `BURST` messages, each as soon as the one before has been received or recovered.

    Raises:
        RuntimeError: the subscriber's process does not start.
    """
    return asyncio.run(_publish_events(messages))


async def _publish_events(messages: int) -> dict[str, Any]:
    started_s = time.monotonic()
    async with _Reader(_read_events) as reader:
        while not reader.connection.poll():  # the subscription may still be on its way
            reader.bus.publish(topics.EVENTS, {"stamp_ns": _WARM_UP, "level": "info", "text": "event"})
            await asyncio.sleep(0.05)
        reader.connection.recv()
        early_kb = 0
        for first in range(0, messages, BURST):
            end = min(first + BURST, messages)
            for number in range(first, end):
                reader.bus.publish(topics.EVENTS, {"stamp_ns": number, "level": "info", "text": "event"})
            if not await reader.received(end):
                break
            if not early_kb and end >= messages // 10:
                early_kb = _resident_kb()
                reader.connection.send("memory")
        grown_kb = _resident_kb() - early_kb
        result = await reader.result()
    return {
        "messages": messages,
        "received": result["received"],
        "lost": messages - result["received"],
        "seconds": round(time.monotonic() - started_s, 1),
        "publisher_growth_kb": grown_kb,
        "subscriber_growth_kb": result["growth_kb"],
    }


class _Reader:
    """A bus in this process and a subscriber in another one, as an asynchronous context manager."""

    def __init__(self, target: Any) -> None:
        self._settings = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
        self._target = target

    async def __aenter__(self) -> _Reader:
        self.bus = Bus(self._settings, VEHICLE, on_event=lambda *_: None, on_command=_no_command)
        await self.bus.start()
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        arguments = (self._settings.listen[0], theirs)
        self._process = context.Process(target=self._target, args=arguments, daemon=True)
        self._process.start()
        theirs.close()
        if not await asyncio.to_thread(self.connection.poll, _START_S):
            await self.__aexit__()  # an open session's threads would keep this process
            raise RuntimeError(f"the subscriber's process did not start within {_START_S:g} s")
        self.connection.recv()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        await self.bus.close()

    async def received(self, count: int) -> bool:
        """Wait until the subscriber has received this many; False after `RECOVERY_S`."""
        self.connection.send(count)
        if not await asyncio.to_thread(self.connection.poll, RECOVERY_S):
            return False
        return bool(self.connection.recv() == count)

    async def result(self) -> dict[str, Any]:
        """End the subscriber and return what it counted."""
        self.connection.send("end")
        result: dict[str, Any] = await asyncio.to_thread(self.connection.recv)
        return result


def _read_detections(endpoint: str, connection: Connection) -> None:
    schedule_as_any_program()
    times: list[tuple[int, int]] = []

    def receive(sample: zenoh.Sample) -> None:
        received_ns = time.monotonic_ns()
        sequence = parse_object(copy_payload(sample.payload, topics.DETECTIONS.largest_bytes))["sequence"]
        if sequence >= 0:
            times.append((sequence, received_ns))

    with open_client(client_settings(ZenohSection(listen=(endpoint,)))) as session:
        subscriber = session.declare_subscriber(topics.DETECTIONS.key(VEHICLE), receive)
        connection.send("ready")
        connection.recv()
        connection.send({"times": times})
        subscriber.undeclare()  # type: ignore[no-untyped-call]


def _read_events(endpoint: str, connection: Connection) -> None:
    newest, expected = _WARM_UP, 0
    missing: set[int] = set()
    changed = threading.Condition()
    started = threading.Event()

    def complete() -> bool:
        return newest >= expected - 1 and not missing

    def receive(sample: zenoh.Sample) -> None:
        nonlocal newest
        number = parse_object(copy_payload(sample.payload, topics.EVENTS.largest_bytes))["stamp_ns"]
        started.set()
        with changed:
            missing.discard(number)
            missing.update(range(newest + 1, number))
            newest = max(newest, number)
            changed.notify()

    with open_client(client_settings(ZenohSection(listen=(endpoint,)))) as session:
        subscriber = subscribe_kept(session, topics.EVENTS.key(VEHICLE), receive)
        connection.send("ready")
        started.wait(_START_S)
        connection.send("started")
        early_kb = _resident_kb()
        while (request := connection.recv()) != "end":
            if request == "memory":
                early_kb = _resident_kb()
                continue
            expected = request
            with changed:
                changed.wait_for(complete, RECOVERY_S)
            connection.send(request)
        connection.send({"received": newest + 1 - len(missing), "growth_kb": _resident_kb() - early_kb})
        subscriber.undeclare()  # type: ignore[no-untyped-call]


def _resident_kb() -> int:
    """Resident memory of this process (proc_pid_statm(5))."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


async def _no_command(text: str) -> dict[str, Any]:
    return {"command": text, "success": False, "reason": "a benchmark executes no commands"}


def _detections(sequence: int) -> DetectionsBody:
    car: DetectionBody = {
        "class_id": 2,
        "class_name": "car",
        "confidence": 0.93,
        "xyxy": [301.2, 198.0, 388.7, 251.4],
        "center": [344.95, 224.7],
        "depth_m": 11.32,
        "nearest_camera_m": [0.61, 0.18, 11.32],
        "track_id": 7,
        "track_score": 0.88,
        "track_state": "confirmed",
        "object_id": 1,
        "track_age_s": 3.2,
        "bearing_rad": 0.0512,
        "elevation_rad": -0.0213,
        "ground_range_m": 11.337,
        "distance_m": 11.34,
        "range_source": "depth",
        "range_sigma_m": 0.147,
        "depth_sigma_m": 0.147,
        "distance_sigma_m": 0.147,
        "position_ned_m": [11.323, 0.581, -2.41],
        "latitude_deg": 47.39781404,
        "longitude_deg": 8.54560773,
        "altitude_amsl_m": 490.41,
        "error_ellipse": {"semi_major_m": 0.38, "semi_minor_m": 0.352, "orientation_rad": 1.622},
    }
    now_ns = time.monotonic_ns()
    seen: ObjectBody = {
        "object_id": 1,
        "track_ids": [7],
        "class_name": "car",
        "position_ned_m": [11.323124861, 0.581204417, -2.410362913],
        "latitude_deg": 47.39781404,
        "longitude_deg": 8.54560773,
        "altitude_amsl_m": 490.41,
        "velocity_ned_mps": [0.031442871, -0.012398114],
        "covariance": [0.023149871203] * 16,
        "moving": False,
        "located_ns": now_ns,
        "first_ns": now_ns,
        "last_ns": now_ns,
        "confirmed": True,
        "ambiguous": False,
        "doubt": 0.0,
        "occluded": False,
        "frames": 36,
    }
    return {
        "vehicle": VEHICLE,
        "camera": None,
        "sequence": sequence,
        "captured_ns": now_ns,
        "published_ns": now_ns,
        "width": 640,
        "height": 480,
        "captured_boot_ns": None,
        "captured_boot_error_ns": None,
        "inferred_ns": now_ns,
        "model": "default",
        "model_sha256": None,
        "localization_error": "",
        "timing_ms": {"preprocess": 1.1, "inference": 21.0, "postprocess": 0.8},
        "dropped": 0,
        "detections": [car] * DETECTIONS,
        "objects": [seen] * DETECTIONS,
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate-hz", type=float, default=30.0, help="Messages a second.")
    cores = len(os.sched_getaffinity(0))
    parser.add_argument("--load", type=int, default=cores, help="Number of detectors beside it.")
    parser.add_argument("--priority", choices=get_args(Priority), default="low", help="As detector.priority.")
    parser.add_argument(
        "--recovered", type=int, help="Instead publish so many messages of a recovered topic."
    )
    arguments = parser.parse_args()
    try:
        if arguments.recovered is not None:
            figures = measure_recovery(arguments.recovered)
        else:
            figures = measure_bus(
                arguments.seconds,
                rate_hz=arguments.rate_hz,
                load=arguments.load,
                priority=arguments.priority,
            )
    except (BusError, OSError, RuntimeError) as error:
        parser.exit(2, f"{error}\n")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
