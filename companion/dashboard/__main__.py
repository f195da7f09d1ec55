"""The dashboard as a child process: `python -m companion.dashboard`, options as JSON.

It prints the page's address, or one line why there is none now, or never. It ends with its parent.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys

from companion.bus.client import settings_in_child
from companion.bus.config import BusError
from companion.dashboard.access import DashboardError
from companion.dashboard.server import NICENESS, DashboardOptions, serve
from companion.host.child_process import EXIT_REFUSED, on_parent_end, read_options
from companion.host.passing import EXIT_PASSING, PassingError
from companion.host.scheduling import lower_priority
from companion.settings import LanguageSection


def main() -> int:
    """Serve; returns the exit code."""
    lower_priority(NICENESS)
    values = json.loads(read_options())
    zenoh = settings_in_child(values.pop("zenoh"))
    language = LanguageSection.model_validate_json(json.dumps(values.pop("language")))
    plugins, hosts = tuple(values.pop("plugins")), tuple(values.pop("hosts"))
    on_parent_end(lambda: os._exit(0))  # zenoh's threads and open streams need no shutdown
    try:
        options = DashboardOptions(zenoh=zenoh, language=language, plugins=plugins, hosts=hosts, **values)
        asyncio.run(serve(options, lambda url: print(url, flush=True), "--dashboard-listen"))
    except (DashboardError, BusError, PassingError) as error:
        print(error, flush=True)
        return EXIT_PASSING if isinstance(error, PassingError) else EXIT_REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
