"""The score of a language model on the tests' sentences, from a checkout; for development only.

    python -m tools.language_score --url http://127.0.0.1:8080/v1 --model NAME

Each sentence is a conversation as `companion ask` has it, to its end; plans are confirmed and only recorded.
"""

from __future__ import annotations

import argparse
import asyncio
import runpy
import statistics
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from companion.guidance.command import GrammarError
from companion.guidance.grammar import json_schema, parse
from companion.language.clauses import Question, UnclearError
from companion.language.control import Control
from companion.language.conversation import Conversation, Operator
from companion.language.endpoints import Endpoint, LanguageError, Message, endpoint_of
from companion.language.scene import Scene
from companion.language.sentences import understand
from companion.language.tools import ToolCall, calls_in, read_call, tools_of

TABLE = Path(__file__).parents[1] / "tests/companion/language/sentence_table.py"
if not TABLE.is_file():
    sys.exit(f"{TABLE}: not found: run this tool from a whole checkout, which has the tests' sentences")
_TABLE = runpy.run_path(str(TABLE))
CLASSES, SCENE, SENTENCES, UNCLEAR = (_TABLE[name] for name in ("CLASSES", "SCENE", "SENTENCES", "UNCLEAR"))
TOOL_NAMES = {tool["function"]["name"] for tool in tools_of(json_schema(CLASSES))}
ORBIT = ToolCall("orbit", {"class": "boat", "radius": 10}, "call_0")


class Recorder:
    """The vehicle and the model of one conversation, of which all calls are noted."""

    def __init__(self, model: Endpoint) -> None:
        self.model, self.said, self.refused = model, "", 0
        self.earlier, self.executed, self.questions = list[Message](), list[str](), list[str]()

    async def answer(self, messages: Sequence[Message], tools: Any, on_text: Any) -> Message:
        if self.earlier:
            return self.earlier.pop(0)
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
        self.executed += [step["do"] for step in tomllib.loads(plan)["step"]] if plan else [first]
        return {"command": text, "success": True, "reason": "done"}

    async def scene(self) -> Scene:
        return cast(Scene, replace(SCENE, last=None))

    async def control(self) -> Control:
        return Control()

    def ending(self, reply: dict[str, Any]) -> None:
        return None

    async def state(self) -> dict[str, Any]:
        return {"mode": "HOLD", "height_above_home_m": 5.0, "heading_deg": 90, "battery_percent": 81}


def refers_to_earlier(text: str) -> bool:
    try:
        return understand(text, replace(SCENE, last=None)) != understand(text, SCENE)
    except UnclearError:
        return any(text == each for each, _ in SENTENCES)


async def verdict(text: str, expected: Sequence[str], model: Endpoint) -> tuple[str, Recorder]:
    """`expected`: all commands, as in the table; empty: none may be executed. More questions are allowed."""
    recorder = Recorder(model)
    operator = Operator(lambda _: None, lambda _: None, lambda: asyncio.sleep(0, True))
    conversation = Conversation(recorder, operator, json_schema(CLASSES), CLASSES, endpoint=recorder)
    if refers_to_earlier(text):
        recorder.earlier += [Message("assistant", "", (ORBIT,)), Message("assistant", "The boat is circled.")]
        await conversation.ask("circle the boat at ten metres")
        recorder.executed.clear()
    try:
        await conversation.ask(text)
    except LanguageError as error:
        recorder.said = str(error)
        return "error", recorder
    wanted = [parse(each) for each in expected if not each.startswith("?")]
    asked = [each for each in expected if each.startswith("?")]
    # A model cannot ask for a colour or a track.
    answered = all(any(f"{each} ".startswith(f"{given} ") for given in recorder.questions) for each in asked)
    if [parse(each) for each in recorder.executed] == wanted and answered:
        return "right", recorder
    return "wrong call" if recorder.executed else "refused" if recorder.refused else "no call", recorder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--url", default="http://127.0.0.1:11434", help="ends with /v1 for OpenAI's format")
    parser.add_argument("--model", required=True)
    parser.add_argument("--timeout", type=float, default=120.0, help="of one answer, seconds")
    parser.add_argument("--every", type=int, default=1, help="use every nth sentence")
    options = parser.parse_args()
    if options.every < 1:
        parser.exit(2, f"language_score: --every must be 1 or more, got {options.every}\n")
    model = endpoint_of(options.url, options.model, timeout_s=options.timeout)
    for name, table in ("with a call", SENTENCES), ("unclear", [(text, ()) for text, _ in UNCLEAR]):
        verdicts, seconds = Counter[str](), list[float]()
        for text, expected in table[:: options.every]:
            started = time.perf_counter()
            found, recorder = asyncio.run(verdict(text, expected, model))
            seconds.append(time.perf_counter() - started)
            verdicts[found] += 1
            calls = "; ".join([*recorder.questions, *recorder.executed]) or repr(recorder.said[:200])
            print(f"{found:10} {seconds[-1]:6.1f} s  {text!r}: {calls}", flush=True)
        times = f"median {statistics.median(seconds):.1f} s, most {max(seconds):.1f} s a sentence"
        print(f"{name}: {verdicts['right']} of {len(seconds)} right; {dict(verdicts)}; {times}\n")


if __name__ == "__main__":
    main()
