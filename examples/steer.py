"""Take off, fly a square by velocities, land: `python steer.py tcp/127.0.0.1:7447`."""

import asyncio
import math
import sys

from companion import connect

SIDE_M, SPEED_MPS, TURN_RADPS = 3.0, 1.0, 0.8


async def main(endpoint: str) -> None:
    async with connect(endpoint) as drone:
        await drone.takeoff(3)
        states = drone.vehicle()  # ten times a second
        state = await anext(states)
        heading, (north, east, _) = state["yaw_rad"], state["position_ned_m"]
        async with drone.steer() as steering:
            for _ in range(4):
                async for state in states:  # until it has turned
                    left = math.remainder(heading - state["yaw_rad"], math.tau)
                    if abs(left) < 0.05:
                        break
                    steering.send(turn=max(-TURN_RADPS, min(TURN_RADPS, 2 * left)))
                north, east = north + SIDE_M * math.cos(heading), east + SIDE_M * math.sin(heading)
                async for state in states:  # until it is at the corner
                    to_north, to_east = north - state["position_ned_m"][0], east - state["position_ned_m"][1]
                    distance = math.hypot(to_north, to_east)
                    if distance < 0.2:
                        break
                    speed = min(SPEED_MPS, 2 * distance)
                    bearing = math.atan2(to_east, to_north) - state["yaw_rad"]
                    steering.send(forward=speed * math.cos(bearing), right=speed * math.sin(bearing))
                print("corner at", state["position_ned_m"], flush=True)
                heading += math.radians(90)
        await drone.land()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
