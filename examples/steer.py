"""Take off, fly a square by velocities, land: `python steer.py tcp/127.0.0.1:7447`."""

import asyncio
import math
import sys

from companion import connect
from companion.client import Steering

SIDE_S, SPEED_MPS, TURN_RADPS = 3.0, 1.0, 0.8


async def send_for(seconds: float, steering: Steering, **velocity: float) -> None:
    """Send a velocity ten times a second: the service brakes 0.5 s after the last one."""
    for _ in range(round(seconds / 0.1)):
        steering.send(**velocity)
        await asyncio.sleep(0.1)


async def main(endpoint: str) -> None:
    async with connect(endpoint) as drone:
        await drone.takeoff(3)
        async with drone.steer() as steering:
            for _ in range(4):
                await send_for(SIDE_S, steering, forward=SPEED_MPS)
                await send_for(math.radians(90) / TURN_RADPS, steering, turn=TURN_RADPS)
                state = await anext(drone.vehicle())
                print("corner at", state["position_ned_m"], flush=True)
        await drone.land()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
