"""A camera of ROS 2, run by the Python of ROS: `image_publisher.py OPTIONS [--ros-args …]`.

Options (JSON): topic; kind: `bgr8`, or `jpeg`, which is read from standard input; depth: also publish `depth`
(16UC1, 2.5 m) and `camera_info` beside the topic; width, height; rate_hz; clock_speed: publish /clock that
runs so fast, 0: do not. It publishes while there are subscribers, and prints for each message the stamp and
CLOCK_MONOTONIC of the same moment, nanoseconds.
"""

from __future__ import annotations

import json
import sys
import time
from array import array
from typing import Any

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock  # type: ignore[import-not-found]
from sensor_msgs.msg import CameraInfo, CompressedImage, Image  # type: ignore[import-not-found]

CLOCK_HZ = 200.0
SIMULATED_BEGIN_NS = 5_000_000_000
# Two readings are of the same moment if no more time has passed between them.
SAME_MOMENT_NS = 50_000


def message_of(options: dict[str, Any]) -> Any:
    width, height = options["width"], options["height"]
    if options["kind"] == "jpeg":
        return CompressedImage(format="bgr8; jpeg compressed bgr8", data=array("B", sys.stdin.buffer.read()))
    size = 3 * width * height
    return Image(
        height=height,
        width=width,
        encoding="bgr8",
        step=3 * width,
        data=array("B", bytes(range(256)) * (size // 256 + 1))[:size],
    )


def depth_and_info(width: int, height: int) -> list[Any]:
    data = array("B", (2500).to_bytes(2, "little") * (width * height))
    k = [300.0, 0.0, width / 2, 0.0, 300.0, height / 2, 0.0, 0.0, 1.0]
    return [
        Image(height=height, width=width, encoding="16UC1", step=2 * width, data=data),
        CameraInfo(
            height=height, width=width, distortion_model="plumb_bob", d=[0.1, 0.0, 0.0, 0.0, 0.0], k=k
        ),
    ]


def moment_ns() -> tuple[int, int]:
    """CLOCK_MONOTONIC and system time of the same moment."""
    while True:
        monotonic_ns, system_ns = time.monotonic_ns(), time.time_ns()
        if time.monotonic_ns() - monotonic_ns < SAME_MOMENT_NS:
            return monotonic_ns, system_ns


def main(options: dict[str, Any], ros_arguments: list[str]) -> None:
    rclpy.init(args=ros_arguments)
    node = rclpy.create_node("camera")
    message, speed = message_of(options), options["clock_speed"]
    # As the drivers of cameras: nothing waits for a slow subscriber.
    profile = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
    messages = [(node.create_publisher(type(message), options["topic"], profile), message)]
    if options["depth"]:
        beside = options["topic"].rpartition("/")[0]
        for name, other in zip(
            ("depth", "camera_info"), depth_and_info(options["width"], options["height"]), strict=True
        ):
            messages.append((node.create_publisher(type(other), f"{beside}/{name}", profile), other))
    clock = node.create_publisher(Clock, "/clock", 10) if speed else None
    begin_ns, next_s, next_clock_s = time.monotonic_ns(), 0.0, 0.0

    def simulated(monotonic_ns: int) -> int:
        return SIMULATED_BEGIN_NS + int((monotonic_ns - begin_ns) * speed)

    while True:
        monotonic_ns, system_ns = moment_ns()
        now_s = (monotonic_ns - begin_ns) / 1e9
        if clock is not None and now_s >= next_clock_s:
            next_clock_s = now_s + 1 / CLOCK_HZ
            clock.publish(Clock(clock=Time(nanoseconds=simulated(monotonic_ns)).to_msg()))
        if now_s >= next_s:
            next_s = max(next_s + 1 / options["rate_hz"], now_s)
            if all(publisher.get_subscription_count() for publisher, _ in messages):
                stamp_ns = simulated(monotonic_ns) if speed else system_ns
                for publisher, each in messages:
                    each.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
                    publisher.publish(each)
                print(stamp_ns, monotonic_ns, flush=True)
        time.sleep(0.0005)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]), sys.argv[2:])
