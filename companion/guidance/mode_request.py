"""Carries a request for one of the autopilot's own modes out, step by step."""

from __future__ import annotations

import asyncio

from companion.guidance.behaviour import ModeRequest
from companion.vehicle.driver import Driver
from companion.vehicle.state import FlightMode

# After a change of mode PX4 runs its pre-arm checks anew; the result comes with the next heartbeat.
READY_TIMEOUT_S = 3.0


async def perform(driver: Driver, request: ModeRequest) -> None:
    """Ask, and return when the vehicle shows it. Arms only for a take-off that says so.

    Raises:
        CommandRefusedError: with the vehicle's reason.
    """
    if request.mode is not FlightMode.TAKEOFF:
        await driver.set_mode(request.mode)
        return
    if request.altitude_m is None:
        raise ValueError("a take-off needs an altitude")
    if request.arm and not driver.state.armed:
        # Landed, PX4 may show a mode in which it never arms: the one from before the landing.
        if driver.state.mode is not FlightMode.HOLD:
            await driver.set_mode(FlightMode.HOLD)
        await _ready_to_arm(driver)
        await driver.arm()
    await driver.takeoff(request.altitude_m)


async def _ready_to_arm(driver: Driver) -> None:
    """Wait for the pre-arm checks, but not for ever: asked anyway, the autopilot says what is wrong."""
    if driver.state.ready_to_arm:
        return
    ready = asyncio.Event()
    unsubscribe = driver.subscribe(lambda state: ready.set() if state.ready_to_arm else None)
    try:
        # Not `wait_for`: on Python 3.11 it may lose a cancellation, and a dropped request would still arm.
        async with asyncio.timeout(READY_TIMEOUT_S):
            await ready.wait()
    except TimeoutError:
        return
    finally:
        unsubscribe()
