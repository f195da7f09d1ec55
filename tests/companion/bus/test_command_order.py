"""The order in which the commands of one sender are sent."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from companion.bus import client
from companion.bus.client import NoAnswerError, send_command, set_settings
from companion.bus.command_order import STOPPED, TOO_LATE, WITHDRAWN, CommandOrder, Turn, is_stop

VEHICLE = "hawk"
# Far longer than a test takes: whoever waits for this long has not got its turn.
LONG_S = 60.0
SHORT_S = 0.02


class PanicError(BaseException):
    """As of a fault in zenoh's own language."""


class Sender:
    """Sends from threads, and notes what was sent."""

    def __init__(self, order: CommandOrder) -> None:
        self.order, self.sent = order, list[str]()
        self._pool = ThreadPoolExecutor(8)

    def send(self, name: str, turn: Turn, before: Callable[[], object] = bool) -> Future[str | None]:
        """`before`: what the thread does before it waits for its turn."""

        def work() -> str | None:
            with turn:
                before()
                if (not_sent := turn.wait()) is None:
                    self.sent.append(name)
                return not_sent

        return self._pool.submit(work)


@pytest.fixture
def order() -> CommandOrder:
    return CommandOrder(LONG_S, LONG_S)


def test_commands_and_settings_are_sent_in_the_order_of_turns(order: CommandOrder) -> None:
    sender, ready = Sender(order), threading.Event()
    turns = [order.turn(VEHICLE, text) for text in ("goto 1 0", None, "goto 2 0", "hold")]
    slow = sender.send("0", turns[0], lambda: ready.wait(LONG_S))
    others = [sender.send(str(number), turns[number], ready.set) for number in (3, 2, 1)]
    assert [each.result(LONG_S) for each in (slow, *others)] == [None] * 4
    assert sender.sent == ["0", "1", "2", "3"]


@pytest.mark.parametrize("error", [RuntimeError, PanicError])
def test_a_command_that_fails_leaves_the_next_its_turn(
    order: CommandOrder, error: type[BaseException]
) -> None:
    failing, following = order.turn(VEHICLE, "goto 1 0"), order.turn(VEHICLE, "hold")
    with pytest.raises(error), failing:
        raise error
    assert following.wait() is None


def test_a_command_that_never_is_ready_is_not_sent_late() -> None:
    order = CommandOrder(SHORT_S, LONG_S)
    hanging, second, third = (order.turn(VEHICLE, text) for text in ("goto 1 0", "goto 2 0", "hold"))
    sender = Sender(order)
    last, before = sender.send("third", third), sender.send("second", second)
    assert (last.result(LONG_S), before.result(LONG_S)) == (None, None)
    assert sender.sent == ["second", "third"]
    assert hanging.wait() == TOO_LATE


def test_a_send_that_never_returns_delays_the_next_shortly() -> None:
    order = CommandOrder(SHORT_S, SHORT_S)
    hanging, second = order.turn(VEHICLE, "goto 1 0"), order.turn(VEHICLE, "goto 2 0")
    assert hanging.wait() is None
    assert second.wait() is None
    assert order.turn(VEHICLE, "stop").wait() is None


def test_stop_is_sent_at_once_and_those_that_wait_are_not(order: CommandOrder) -> None:
    waiting = [order.turn(VEHICLE, text) for text in ("goto 1 0", "mission demo\n[[step]]", "hold")]
    sender = Sender(order)
    waits = [sender.send("waiting", turn) for turn in waiting[1:]]
    stop, later = order.turn(VEHICLE, " Stop\n"), order.turn(VEHICLE, "hold")
    after = sender.send("later", later)
    assert [each.result(LONG_S) for each in waits] == [STOPPED, STOPPED]
    assert waiting[0].wait() == STOPPED
    with stop:
        assert stop.wait() is None
        sender.sent.append("stop")
    assert after.result(LONG_S) is None
    assert sender.sent == ["stop", "later"]


def test_stop_follows_a_command_that_is_being_sent(order: CommandOrder) -> None:
    sender, ready = Sender(order), threading.Event()
    sending = order.turn(VEHICLE, "goto 1 0")
    with sending:
        assert sending.wait() is None
        stop = sender.send("stop", order.turn(VEHICLE, "stop"), ready.set)
        assert ready.wait(LONG_S)
        sender.sent.append("goto")
    assert stop.result(LONG_S) is None
    assert sender.sent == ["goto", "stop"]


def test_a_stop_does_not_wait_for_another_stop(order: CommandOrder) -> None:
    stops = [order.turn(VEHICLE, "stop") for _ in range(3)]
    assert [stop.wait() for stop in reversed(stops)] == [None] * 3


def test_a_stop_that_is_late_or_withdrawn_is_sent() -> None:
    order = CommandOrder(SHORT_S, SHORT_S)
    late, other = order.turn(VEHICLE, "stop"), order.turn(VEHICLE, "hold")
    assert other.wait() is None
    assert late.wait() is None
    withdrawn = order.turn(VEHICLE, "stop")
    withdrawn.withdraw()
    assert withdrawn.wait() is None


def test_a_change_of_settings_is_sent_in_spite_of_a_stop(order: CommandOrder) -> None:
    settings, stop = order.turn(VEHICLE, None), order.turn(VEHICLE, "stop")
    assert (settings.wait(), stop.wait()) == (None, None)


def test_a_withdrawn_command_is_not_sent(order: CommandOrder) -> None:
    withdrawn, following = order.turn(VEHICLE, "goto 1 0"), order.turn(VEHICLE, "hold")
    withdrawn.withdraw()
    assert following.wait() is None
    assert withdrawn.wait() == WITHDRAWN


def test_a_command_that_is_being_sent_keeps_its_turn_if_withdrawn() -> None:
    order = CommandOrder(LONG_S, LONG_S)
    sender, ready = Sender(order), threading.Event()
    sending, following = order.turn(VEHICLE, "goto 1 0"), order.turn(VEHICLE, "hold")
    assert sending.wait() is None
    sending.withdraw()
    after = sender.send("hold", following, ready.set)
    assert ready.wait(LONG_S)
    sender.sent.append("goto")
    sending.end()
    assert after.result(LONG_S) is None
    assert sender.sent == ["goto", "hold"]


def test_vehicles_do_not_wait_for_each_other(order: CommandOrder) -> None:
    waiting, other = order.turn(VEHICLE, "goto 1 0"), order.turn("owl", "stop")
    assert other.wait() is None
    assert waiting.wait() is None


@pytest.mark.parametrize(
    ("text", "stops"), [("stop", True), (" STOP\n", True), ("stop now", False), ("mission stop", False)]
)
def test_stop_is_recognised_as_the_service_reads_it(text: str, stops: bool) -> None:
    assert is_stop(text) is stops


class Session:
    """The service is there; queries go to `get`."""

    def __init__(self, get: Callable[[], object]) -> None:
        self._get = get

    def get(self, *_: Any, **__: Any) -> Any:
        return self._get()

    def zid(self) -> str:
        return "1"

    def liveliness(self) -> Session:
        return self

    def declare_subscriber(self, key: str, put: Callable[[Any], None], *, history: bool) -> Any:
        put(zenoh.SampleKind.PUT)
        return SimpleNamespace(undeclare=lambda: None)


def session_of(monkeypatch: pytest.MonkeyPatch, get: Callable[[], object]) -> zenoh.Session:
    monkeypatch.setattr(client, "LastStatus", lambda *_: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(client, "_is", lambda item, kind: item == kind)
    return cast(zenoh.Session, Session(get))


def test_next_command_does_not_wait_for_the_answer(
    order: CommandOrder, monkeypatch: pytest.MonkeyPatch
) -> None:
    got: list[str] = []
    session = session_of(monkeypatch, lambda: got.append("goto"))
    first, following = order.turn(VEHICLE, "goto 1 0"), order.turn(VEHICLE, "hold")
    monkeypatch.setattr(client, "_answer", lambda *_: {"following": following.wait()})
    assert send_command(session, VEHICLE, "goto 1 0", turn=first) == {"following": None}
    assert got == ["goto"]


def test_a_send_that_fails_leaves_the_next_its_turn(
    order: CommandOrder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def panic() -> None:
        raise PanicError

    session = session_of(monkeypatch, panic)
    command, settings, following = (order.turn(VEHICLE, text) for text in ("goto 1 0", None, "hold"))
    with pytest.raises(PanicError):
        send_command(session, VEHICLE, "goto 1 0", turn=command)
    with pytest.raises(PanicError):
        set_settings(session, VEHICLE, {}, turn=settings)
    assert following.wait() is None


def test_a_command_before_a_stop_is_answered_without_being_sent(
    order: CommandOrder, monkeypatch: pytest.MonkeyPatch
) -> None:
    got: list[str] = []
    session = session_of(monkeypatch, lambda: got.append("mission"))
    text = "mission demo\n[[step]]"
    waiting, _stop = order.turn(VEHICLE, text), order.turn(VEHICLE, "stop")
    reply = send_command(session, VEHICLE, text, turn=waiting)
    assert reply == {"command": "mission demo", "state": "ended", "success": False, "reason": STOPPED}
    assert got == []


def test_settings_whose_caller_has_gone_are_not_sent(
    order: CommandOrder, monkeypatch: pytest.MonkeyPatch
) -> None:
    got: list[str] = []
    session, turn = session_of(monkeypatch, lambda: got.append("set")), order.turn(VEHICLE, None)
    turn.withdraw()
    with pytest.raises(NoAnswerError):
        set_settings(session, VEHICLE, {}, turn=turn)
    assert got == []
