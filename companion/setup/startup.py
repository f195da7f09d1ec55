"""Watches a start of the service until it is ready, or says why it is not."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path

from companion.bus.bodies.service import StatusBody
from companion.doctor.check import worst_first
from companion.doctor.facts import Facts, Machine, checks_of, user_of_service
from companion.doctor.running import CHECKS
from companion.doctor.screens import status_lines
from companion.doctor.service_query import find_service
from companion.settings import Settings
from companion.setup.systemctl import Host

START_S = 120.0
_PARTS_S = 30.0  # a camera's worker loads its model
_POLL_S = 0.5
_SAID_EVERY_S = 10.0
_JOURNAL_LINES = 15
_WIDTH = 80
_UP = ("ready", "finished")
_AUTOPILOT = "autopilot"
# Codes of ExecMainCode, as of waitid(2): CLD_EXITED; CLD_KILLED and CLD_DUMPED. 0: no process ran.
_EXITED, _SIGNALLED = "1", ("2", "3")


def starts_at_boot(host: Host) -> bool:
    """Whether an enabled service starts with the computer, and not with the user's login: loginctl(1)."""
    return not host.user or (Path("/var/lib/systemd/linger") / user_of_service().name).exists()


def wait_until_up(
    host: Host,
    unit: str,
    settings: Settings | None,
    say: Callable[[str], None],
    before: str | None,
    began_s: float,
) -> bool:
    """Wait until a service is ready, for two minutes at most, and print its state.

    Args:
        settings: of the service; None: they are wrong, and it will end.
        before: InvocationID of the process that is replaced; None: none is.
        began_s: time of day at which the start was requested, seconds since 1970.

    Returns:
        Whether it is ready, or waits for nothing but the autopilot.
    """
    if (why := _wait_for_systemd(host, unit, say, before)) is not None:
        say(f"not up     {unit} {why}; its log:")
        for line in host.journal(unit, began_s, _JOURNAL_LINES).splitlines():
            say(f"    {line}")
        return False
    if settings is None:
        settings = Settings()
    return _say_status(host, unit, settings, say, began_s)


def _wait_for_systemd(host: Host, unit: str, say: Callable[[str], None], before: str | None) -> str | None:
    """Return why the unit is not active; None: it is."""
    start_s, said_s, text = time.monotonic(), 0.0, ""
    while True:
        state = host.show(unit)
        active, waited_s = state.get("ActiveState"), time.monotonic() - start_s
        replaced = before is None or state.get("InvocationID") != before
        if active == "active" and replaced:
            return None
        restarted = state.get("SubState") == "auto-restart" or state.get("NRestarts") not in (None, "", "0")
        if replaced and (active == "failed" or restarted):
            return f"has ended {_how_it_ended(state)}"
        if waited_s > START_S:
            return f"is still {active}: companion status shows when it is ready"
        if state.get("StatusText", "") != text or waited_s - said_s > _SAID_EVERY_S:
            text, said_s = state.get("StatusText", ""), waited_s
            say(f"waiting    {waited_s:.0f} s: {text or active}")
        time.sleep(_POLL_S)


def _how_it_ended(state: Mapping[str, str]) -> str:
    code, status = state.get("ExecMainCode"), state.get("ExecMainStatus")
    if code == _EXITED:
        return f"with exit code {status}"
    if code in _SIGNALLED:
        return f"by signal {status}"
    return f"with the result {state.get('Result')}, and no process"


def _say_status(
    host: Host, unit: str, settings: Settings, say: Callable[[str], None], began_s: float
) -> bool:
    """Print the screen of `companion status`, once every part has come up or failed."""
    start_s = time.monotonic()
    while True:
        found = find_service(settings.zenoh, settings.vehicle.name)
        service = found.service
        status = None if service is None else service.status
        waited_s = time.monotonic() - start_s
        starting = [] if status is None else [p["name"] for p in status["parts"] if p["state"] == "starting"]
        if waited_s > _PARTS_S or (status is not None and not starting):
            break
        say(f"waiting    {waited_s:.0f} s: {', '.join(starting) or 'its first status'}")
        time.sleep(_POLL_S)
    if service is None or status is None:
        say(f"not up     {unit} runs, and does not answer: companion doctor")
        return False
    facts = Facts(found.settings or settings, Machine(), service)
    for line in status_lines(facts, worst_first(checks_of(facts, CHECKS)), _WIDTH):
        say(line)
    if status["healthy"]:
        when = "with this computer" if starts_at_boot(host) else "when you log in"
        say(f"ready      {unit} runs, and starts {when}")
        return True
    missing = _missing(status)
    if all(name == _AUTOPILOT for name in missing):
        say(f"ready      {unit} runs, and waits for the autopilot")
        return True
    say(f"not ready  {', '.join(missing)}; companion doctor finds out why. Warnings of its log:")
    for line in host.journal(unit, began_s, _JOURNAL_LINES).splitlines():
        say(f"    {line}")
    return False


def _missing(status: StatusBody) -> list[str]:
    return [part["name"] for part in status["parts"] if part["state"] not in _UP]
