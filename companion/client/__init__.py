"""An asyncio client of running services: typed commands, messages, steering.

    async with connect("tcp/127.0.0.1:7447") as drone:
        await drone.takeoff(5)
        async for frame in drone.detections():
            print(frame["detections"])

It imports neither torch nor OpenCV nor numpy.
"""

from companion.bus.client import NoAnswerError
from companion.client.drone import CommandFailedError, Drone, Steering, connect
from companion.client.stream import Stream

__all__ = ["CommandFailedError", "Drone", "NoAnswerError", "Steering", "Stream", "connect"]
