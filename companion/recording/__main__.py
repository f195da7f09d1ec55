"""The clients that the service starts: `python -m companion.recording`, options as JSON.

With `listen` it serves Foxglove live (`live.py`), else it records (`recorder.py`).
"""

from __future__ import annotations

import sys

from companion.bus.child_client import ChildClient, run_child
from companion.recording import RecordingError


def _work(client: ChildClient) -> None:
    with client.open_bus() as session:
        if session is None:
            return
    if "listen" in client.options:
        from companion.recording.live import LiveOptions, serve

        serve(LiveOptions(zenoh=client.zenoh, **client.options), client.ending, client.say)
    else:
        from companion.recording.recorder import RecorderOptions, record

        options = RecorderOptions(zenoh=client.zenoh, **client.options)
        record(options, client.ending, client.say, patient=True)


if __name__ == "__main__":
    sys.exit(run_child(_work, refused=(RecordingError,)))
