"""Print the detections of a running service, send it a command, print the reply.

python subscribe.py tcp/127.0.0.1:7447 "takeoff altitude=3"
"""

import json
import sys

from companion.bus.client import client_settings, listen, open_client, send_command
from companion.settings import ZenohSection


def on_detections(key: str, text: str) -> None:
    """Print one message; called in a zenoh thread. Fields: docs/messages.md."""
    message = json.loads(text)
    for record in message["detections"]:
        x, y = record["center"]
        print(
            f"{message['vehicle']} frame {message['sequence']}: {record['class_name']} "
            f"{record['confidence']:.2f} at {x:.0f}, {y:.0f} px, track {record['track_id']}",
            flush=True,
        )


def main(endpoint: str, command: str, vehicle: str = "vehicle1") -> None:
    with open_client(client_settings(ZenohSection(), (endpoint,))) as session:
        listen(session, "detections", on_detections)
        reply = send_command(session, vehicle, command, timeout_s=60.0)
    print(f"{command}: {'done' if reply['success'] else 'failed'}: {reply['reason']}")


if __name__ == "__main__":
    main(*sys.argv[1:])
