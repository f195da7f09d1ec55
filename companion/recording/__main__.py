"""The clients that the service starts: `python -m companion.recording OPTIONS`, as JSON.

With `listen` it serves Foxglove live (`live.py`), else it records (`recorder.py`).
"""

from __future__ import annotations

import json
import signal
import sys
from threading import Event

from companion.bus.client import NoAnswerError, open_client, settings_in_child
from companion.bus.config import BusError
from companion.host.child_process import EXIT_REFUSED, on_parent_end
from companion.host.passing import EXIT_PASSING, PassingError
from companion.recording import PAUSED, RecordingError
from companion.settings import ZenohSection
from vision.extras import missing_module

_RETRY_S = 2.0


def main(argument: str) -> int:
    """Work until the parent ends; returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, as a closed terminal is
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    ending = Event()
    on_parent_end(ending.set)
    values = json.loads(argument)
    zenoh = settings_in_child(values.pop("zenoh"))
    try:
        if not _wait_for_node(zenoh, ending):
            return 0
        if "listen" in values:
            from companion.recording.live import LiveOptions, serve

            serve(LiveOptions(zenoh=zenoh, **values), ending, _say)
        else:
            from companion.recording.recorder import RecorderOptions, record

            record(RecorderOptions(zenoh=zenoh, **values), ending, _say, patient=True)
    except ModuleNotFoundError as error:
        _say(missing_module(error) or str(error))
        return EXIT_REFUSED
    except (PassingError, NoAnswerError) as error:  # or the node has gone since
        _say(str(error))
        return EXIT_PASSING
    except (RecordingError, BusError) as error:
        _say(str(error))
        return EXIT_REFUSED
    return 0


def _wait_for_node(zenoh: ZenohSection, ending: Event) -> bool:
    """Wait for a node, such as a router that starts later; False: ended before."""
    said = False
    while not ending.is_set():
        try:
            with open_client(zenoh):
                return True
        except NoAnswerError as error:
            if not said:
                _say(f"{PAUSED}{error}; retrying")
            said = True
        ending.wait(_RETRY_S)
    return False


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
