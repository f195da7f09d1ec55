"""Print the detections of a running service, send it a command, print the reply.

python subscribe.py tcp/127.0.0.1:7447 "takeoff altitude=3"
"""

import asyncio
import sys

from companion import connect
from companion.client import Drone


async def print_detections(drone: Drone) -> None:
    """Fields: docs/messages.md."""
    async for frame in drone.detections():
        for found in frame["detections"]:
            x, y = found["center"]
            print(
                f"{drone.name} frame {frame['sequence']}: {found['class_name']} "
                f"{found['confidence']:.2f} at {x:.0f}, {y:.0f} px, track {found['track_id']}",
                flush=True,
            )


async def main(endpoint: str, command: str) -> None:
    async with connect(endpoint) as drone:
        printing = asyncio.create_task(print_detections(drone))
        reply = await drone.command(command)
        printing.cancel()
    print(f"{command}: done: {reply['reason']}")


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
