"""A node of another program, for tests. The Python of ROS runs this file; it imports nothing of ours.

`ros_peer.py NAME [--ros-args …]`. It reads requests as JSON, one per line, and prints what it receives:

    {"subscribe": NAME, "type": …, "latched": bool, "reliable": bool}   {"topic": NAME, "message": {…}}
    {"publish": NAME, "type": …, "message": {…}, "times": n, "hz": f, "reliable": bool}
    {"graph": true}                                                    {"nodes": […], "topics": {…}}
"""

from __future__ import annotations

import base64
import contextlib
import importlib
import json
import sys
import threading
from typing import Any


def kind_of(name: str) -> Any:
    package, _, message = name.partition("/msg/")
    return getattr(importlib.import_module(package + ".msg"), message)


def as_data(value: Any) -> Any:
    """A message as JSON-able data; `uint8[]` as base64."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: as_data(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if getattr(value, "typecode", "") == "B" or isinstance(value, bytes):
        return base64.b64encode(bytes(value)).decode()
    if isinstance(value, (str, bool, int, float)):
        return value
    return [as_data(each) for each in value]


def fill(message: Any, data: dict[str, Any]) -> Any:
    for name, value in data.items():
        field = getattr(message, name)
        if isinstance(value, dict) and "zeros" in value:
            setattr(message, name, bytes(value["zeros"]))
        elif isinstance(value, dict):
            fill(field, value)
        else:
            setattr(message, name, value)
    return message


def main() -> None:
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    rclpy.init(args=sys.argv)
    node = rclpy.create_node(sys.argv[1])
    lock = threading.Lock()

    def write(data: Any) -> None:
        with lock:
            print(json.dumps(data), flush=True)

    def profile(request: dict[str, Any]) -> Any:
        return QoSProfile(
            depth=request.get("depth", 100),
            reliability=ReliabilityPolicy.RELIABLE
            if request.get("reliable", True)
            else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL
            if request.get("latched", False)
            else DurabilityPolicy.VOLATILE,
        )

    publishers: dict[str, Any] = {}
    ended = threading.Event()

    def publish(request: dict[str, Any]) -> None:
        name, kind = request["publish"], kind_of(request["type"])
        if name not in publishers:
            publishers[name] = node.create_publisher(kind, name, profile(request))
        publisher = publishers[name]
        while publisher.get_subscription_count() == 0 and not ended.wait(0.02):
            pass
        message = fill(kind(), request["message"])
        for _ in range(request.get("times", 1)):
            publisher.publish(message)
            if ended.wait(1.0 / request.get("hz", 1000.0)):
                return
        write({"published": name})

    def handle(request: dict[str, Any]) -> None:
        if "subscribe" in request:
            name = request["subscribe"]
            node.create_subscription(
                kind_of(request["type"]),
                name,
                lambda message: write({"topic": name, "message": as_data(message)}),
                profile(request),
            )
            write({"subscribed": name})
        elif "publish" in request:
            threading.Thread(target=publish, args=(request,), daemon=True).start()
        else:
            nodes = [f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces()]
            write({"nodes": nodes, "topics": dict(node.get_topic_names_and_types())})

    def read() -> None:
        for line in sys.stdin:
            handle(json.loads(line))
        ended.set()
        rclpy.shutdown()

    threading.Thread(target=read, daemon=True).start()
    write({"ready": node.get_fully_qualified_name()})
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
