"""What the page says of a command: its own function, run in node."""

from __future__ import annotations

from typing import Any

import pytest

from tests.companion.dashboard.page_module import evaluate

pytestmark = pytest.mark.needs("node")

FLOWN = {"command_id": "s-4", "state": "in_progress", "success": True, "reason": "in progress"}
SHOWN = """
(() => {
  const ends = new module.Ends();
  for (const message of given.messages) ends.add(message);
  return module.outcome(given.reply, ends, given.service, given.stale);
})()
"""


def end(
    reason: str, identifier: str = "s-4", state: str = "ended", *, success: bool = False
) -> dict[str, Any]:
    return {"id": identifier, "state": state, "success": success, "reason": reason}


def shown(reply: dict[str, Any], *messages: dict[str, Any], service: str | None = "s") -> list[str]:
    value: list[str] = evaluate(
        "outcome.js", SHOWN, {"reply": reply, "messages": messages, "service": service}
    )
    return value


def test_reply_is_shown_until_the_command_has_ended() -> None:
    assert shown(FLOWN) == ["accepted, in progress", "good"]
    others = end("x", "s-3"), end("x", "t-4"), end("in progress", state="in_progress")
    assert shown(FLOWN, *others) == ["accepted, in progress", "good"]
    assert shown(FLOWN, service=None) == ["accepted, in progress", "good"]
    for reason in ("replaced by hold", "the pilot took over: position mode"):
        assert shown(FLOWN, end(reason)) == [f"ended: {reason}", "ended"]
    text, kind = shown(FLOWN, service="other")
    assert (text.partition(":")[0], kind) == ("ended", "ended")


def test_command_of_a_silent_service_is_not_shown_as_accepted() -> None:
    given = {"reply": FLOWN, "messages": [], "service": "s", "stale": True}
    text, kind = evaluate("outcome.js", SHOWN, given)
    assert ("accepted" in text, kind) == (False, "waiting")
    given["messages"] = [end("replaced by hold")]
    assert evaluate("outcome.js", SHOWN, given) == ["ended: replaced by hold", "ended"]


def test_reply_to_a_command_that_has_ended_is_its_end() -> None:
    for success, word, kind in ((True, "done", "good"), (False, "failed", "bad")):
        reply = {**FLOWN, "state": "ended", "success": success, "reason": "r 7"}
        assert shown(reply, end("r 7", success=success)) == [f"{word}: r 7", kind]
    refused = {"success": False, "reason": "the service is still starting"}
    assert shown(refused) == ["failed: the service is still starting", "bad"]


def test_ends_of_old_commands_are_forgotten() -> None:
    many = [end("x", f"s-{number}") for number in range(5, 600)]
    assert shown(FLOWN, end("old"), *many)[0] == "accepted, in progress"
    assert shown(FLOWN, *many, end("new"))[0] == "ended: new"
