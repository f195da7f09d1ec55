"""The attitude of a vehicle for images without a service: received from its autopilot, or given."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future

import numpy as np
from numpy.typing import NDArray

from companion.perception.assembly import CameraTelemetry
from companion.settings import Settings
from companion.vehicle.state import VehicleState
from vision.tracking import AttitudeHistory


class _Held(AttitudeHistory):
    """One attitude at all times."""

    def __init__(self, ned_from_body: NDArray[np.float64]) -> None:
        super().__init__()
        self._ned_from_body = ned_from_body

    def at(self, stamp_ns: int) -> NDArray[np.float64]:
        """(3, 3) `ned_from_body`."""
        return self._ned_from_body


def held_attitude(ned_from_body: NDArray[np.float64]) -> CameraTelemetry:
    """The telemetry of a vehicle that does not turn; `ned_from_body` is (3, 3)."""
    telemetry = CameraTelemetry()
    telemetry.attitudes = _Held(ned_from_body)
    return telemetry


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
