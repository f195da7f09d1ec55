"""The state of a service in one line, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def status_text(status: Mapping[str, Any]) -> str:
    """Return one line. `status`: the body of the topic `status`."""
    vehicle, pilot = status["vehicle"], status["pilot"]
    words = [f"{vehicle['name']}:"]
    if vehicle["connected"]:
        words.append(f"{vehicle['mode']}, {'armed' if vehicle['armed'] else 'disarmed'},")
        words += ["FAILSAFE,"] if vehicle["failsafe"] else []
    else:
        words.append("no autopilot,")
    command = pilot["command"]
    words.append(f"{'in command' if pilot['in_command'] else 'not in command'},")
    words.append(f"flies {command['command'].splitlines()[0]};" if command else "no command;")
    for name, camera in {"camera": status["perception"], **status["cameras"]}.items():
        if camera["state"] != "stopped":
            words.append(f"{name} {camera['state']}, {camera['rate_hz']:.1f} results/s;")
    words.append("healthy" if status["healthy"] else f"not healthy: {'; '.join(status['unhealthy'])}")
    return " ".join(words)
