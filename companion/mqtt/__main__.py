"""Events and state of a vehicle by MQTT and webhooks: `python -m companion.mqtt`, options as JSON."""

from __future__ import annotations

import sys

from companion.bus.child_client import ChildClient, run_child
from companion.mqtt import MqttError


def _work(client: ChildClient) -> None:
    from companion.mqtt.publisher import publish  # its packages may be missing

    publish(client)


if __name__ == "__main__":
    sys.exit(run_child(_work, refused=(MqttError,)))
