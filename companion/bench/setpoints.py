"""The spacing of setpoints under load, measured on this machine."""

from __future__ import annotations

import asyncio
import multiprocessing
import socket
import threading
import time
from multiprocessing.synchronize import Semaphore

import numpy as np

from companion.host.scheduling import schedule_as_any_program, set_scheduler_slice
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.streamer import Streamer

# SET_POSITION_TARGET_LOCAL_NED in MAVLink 2: what a setpoint weighs on the wire.
_SETPOINT_BYTES = 65
_START_S = 30.0


def measure_setpoints(seconds: float, *, rate_hz: float, load: int) -> dict[str, object]:
    """Spacing of the streamer's datagrams on a loopback socket, with `load` busy processes beside it.

    The receiver stamps in a thread that blocks in `recv`, so its own wake-up is part of the figure.
    """
    context = multiprocessing.get_context("spawn")
    started = context.Semaphore(0)
    loaded = [context.Process(target=busy, args=(started,), daemon=True) for _ in range(load)]
    for process in loaded:
        process.start()
    try:
        for _ in loaded:
            if not started.acquire(timeout=_START_S):
                raise RuntimeError(f"the busy processes did not start within {_START_S:g} s; use fewer")
        arrivals_ns = asyncio.run(_stream(seconds, rate_hz))
    finally:
        for process in loaded:
            process.kill()
            process.join()
    spacing_ms = np.diff(arrivals_ns) / 1e6
    error_ms = np.abs(spacing_ms - 1e3 / rate_hz)
    return {
        "rate_hz": rate_hz,
        "busy_processes": load,
        "setpoints": len(arrivals_ns),
        "spacing_p50_ms": round(float(np.percentile(spacing_ms, 50)), 3),
        "error_p99_ms": round(float(np.percentile(error_ms, 99)), 3),
        "error_max_ms": round(float(error_ms.max()), 3),
    }


async def _stream(seconds: float, rate_hz: float) -> list[int]:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect(receiver.getsockname())
    arrivals_ns: list[int] = []
    receiving = threading.Event()

    def receive() -> None:
        set_scheduler_slice()
        receiving.set()
        while receiver.recv(256):
            arrivals_ns.append(time.monotonic_ns())

    thread = threading.Thread(target=receive)
    thread.start()
    receiving.wait()

    def send(_: Setpoint) -> None:
        sender.send(bytes(_SETPOINT_BYTES))

    streamer = Streamer(send, rate_hz=rate_hz)
    streamer.submit(Setpoint.brake(time.monotonic_ns(), lifetime_s=seconds + 1))
    task = asyncio.create_task(streamer.run())
    await asyncio.sleep(seconds)
    task.cancel()
    sender.send(b"")  # an empty datagram ends the receiver
    await asyncio.to_thread(thread.join)
    receiver.close()
    sender.close()
    return arrivals_ns


def busy(started: Semaphore) -> None:
    """Use one core until killed, with the policy of any program. `started` is released before."""
    schedule_as_any_program()
    started.release()
    value = 0
    while True:
        value += 1
