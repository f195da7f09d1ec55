"""The score of a language model on the tests' sentences; for development only.

    python -m tools.language_score --url http://127.0.0.1:8080/v1 --model NAME

Each sentence is a conversation of its own, as `companion ask` has it. Before those that refer to an earlier
command ("twice as far") there is an exchange about a circle. Every plan is confirmed, and only recorded; the
model is not asked again after as many commands as are expected.
"""

from __future__ import annotations

import argparse
import asyncio
import statistics
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from companion.guidance.command import GrammarError
from companion.guidance.grammar import json_schema, parse
from companion.language.clauses import Question, UnclearError
from companion.language.conversation import Conversation, Operator
from companion.language.endpoints import Endpoint, LanguageError, Message, endpoint_of
from companion.language.sentences import understand
from companion.language.tools import ToolCall, calls_in, read_call, tools_of
from tests.companion.language.sentence_table import CLASSES, SCENE, SENTENCES, UNCLEAR
from tests.companion.language.test_conversation import FakeVehicle

EARLIER = "circle the boat at ten metres"
ORBIT = ToolCall("orbit", {"class": "boat", "radius": 10}, "call_0")
SCHEMA = json_schema(CLASSES)
TOOL_NAMES = {tool["function"]["name"] for tool in tools_of(SCHEMA)}


class Recorder(FakeVehicle):
    """The vehicle and the model of one conversation, of which all calls are noted."""

    def __init__(self, model: Endpoint, commands: int) -> None:
        super().__init__()
        self.model, self.expected, self.said, self.refused = model, max(commands, 1), "", 0
        self.earlier, self.flown, self.questions = list[Message](), list[str](), list[str]()

    async def answer(
        self, messages: Sequence[Message], tools: list[dict[str, Any]], on_text: Callable[[str], None]
    ) -> Message:
        if self.earlier:
            return self.earlier.pop(0)
        if len(self.flown) >= self.expected:
            return Message("assistant", "")
        answer = await self.model.answer(messages, tools, on_text)
        self.said += answer.content
        for call in answer.calls or calls_in(answer.content, TOOL_NAMES):
            try:
                intent = read_call(call, CLASSES)
                self.questions += [str(intent)] if isinstance(intent, Question) else []
            except GrammarError:
                self.refused += 1
        return answer

    async def command(self, text: str) -> dict[str, Any]:
        first, _, plan = text.partition("\n")
        self.flown += [step["do"] for step in tomllib.loads(plan)["step"]] if plan else [first]
        return await super().command(text)

    async def confirm(self) -> bool:
        return True


def refers_to_earlier(text: str) -> bool:
    try:
        return understand(text, replace(SCENE, last=None)) != understand(text, SCENE)
    except UnclearError:
        return any(text == each for each, _ in SENTENCES)


async def verdict(text: str, expected: Sequence[str], model: Endpoint) -> tuple[str, Recorder]:
    """`expected`: as in the table; empty: nothing may be flown. Questions before a command are allowed."""
    wanted = [str(parse(each)) for each in expected if not each.startswith("?")]
    recorder = Recorder(model, len(wanted))
    operator = Operator(lambda _: None, lambda _: None, recorder.confirm)
    conversation = Conversation(recorder, operator, SCHEMA, CLASSES, endpoint=recorder)
    if refers_to_earlier(text):
        recorder.earlier += [Message("assistant", "", (ORBIT,)), Message("assistant", "The boat is circled.")]
        await conversation.ask(EARLIER)
        recorder.flown.clear()
    try:
        await conversation.ask(text)
    except LanguageError as error:
        recorder.said = str(error)
        return "error", recorder
    asked = [{each, each.split()[0]} for each in expected if each.startswith("?")]
    if recorder.flown == wanted and all(each & set(recorder.questions) for each in asked):
        return "right", recorder
    return "wrong call" if recorder.flown else "refused" if recorder.refused else "no call", recorder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="http://127.0.0.1:11434", help="ends with /v1 for OpenAI's format")
    parser.add_argument("--model", required=True)
    parser.add_argument("--timeout", type=float, default=120.0, help="of one answer, seconds")
    parser.add_argument("--every", type=int, default=1, help="use every nth sentence")
    options = parser.parse_args()
    model = endpoint_of(options.url, options.model, timeout_s=options.timeout)
    for name, table in ("with a call", SENTENCES), ("unclear", [(text, ()) for text, _ in UNCLEAR]):
        verdicts, seconds = Counter[str](), list[float]()
        for text, expected in table[:: options.every]:
            started = time.perf_counter()
            found, recorder = asyncio.run(verdict(text, expected, model))
            seconds.append(time.perf_counter() - started)
            verdicts[found] += 1
            calls = "; ".join([*recorder.questions, *recorder.flown]) or repr(recorder.said[:200])
            print(f"{found:10} {seconds[-1]:6.1f} s  {text!r}: {calls}", flush=True)
        times = f"median {statistics.median(seconds):.1f} s, most {max(seconds):.1f} s a sentence"
        print(f"{name}: {verdicts['right']} of {len(seconds)} right; {dict(verdicts)}; {times}\n")


if __name__ == "__main__":
    main()
