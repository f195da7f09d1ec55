"""Plain sentences to commands and questions, by patterns: no model, the same answer every time.

    "take off to five metres, find the car and circle it twice at ten metres"
    → takeoff 5; seek car; orbit car radius=10 laps=2

A sentence is divided into clauses that begin with a verb. Every word of a clause must be understood: a clause
with a condition that no command expresses is refused, not shortened. What is ambiguous is asked back.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, replace
from typing import Any

from companion.guidance.command import Command
from companion.language.clauses import (
    CHOICE,
    COLOUR,
    POLITE,
    Clause,
    NotSeenError,
    Question,
    UnclearError,
    make_command,
)
from companion.language.nouns import COLOUR_WORDS, classes_of, noun_pattern
from companion.language.numbers_in_words import with_numbers
from companion.language.scene import Scene


@dataclass(frozen=True, slots=True)
class Reading:
    """What a sentence asks for, in order.

    Attributes:
        done: not None: an object is searched for last; read the sentence again afterwards, with this number.
    """

    intents: tuple[Command | Question, ...]
    done: int | None = None


_VERBS = (
    "take|launch|climb|land|come|return|go|fly|move|stop|halt|abort|freeze|hold|hover|wait|stay|circle|orbit"
    "|find|search|look|seek|locate|approach|follow|chase|tail|point|aim|turn|face|descend|rise|ascend|get|keep"
    "|back|rtl|track|twice|half"
)
_SPLIT = re.compile(
    rf"(?:[,;.]? (?:and then|then|after that|afterwards|and)|[,;.]) (?=(?:please )?(?:{_VERBS})\b)"
)
# Further words of a question.
_REST = rf"(?: (?!.*\b(?:{_VERBS})\b).*)?"
# Of a question about what is seen. Another word may restrict it, and must be understood.
_SEEN_REST = (
    r"(?: (?:right )?now| (?:(?:is|are) )?(?:there|here|nearby|around|visible|in (?:view|sight))"
    r"| in front(?: of (?:you|us))?| from (?:here|you|us)| (?:do|can) you see)*"
)
_STOP_WORDS = "stop|halt|abort|freeze"
_STOP = re.compile(rf"[,;. ]*(?:emergency )?(?:{_STOP_WORDS})\b")
# After these a verb is a noun: "stop the search", "abort landing".
_NOUN_IN_STOP = re.compile(r"\b(?:the|this|that|your|my|abort) (?:take off|\w+)")
_OTHER_IN_STOP = re.compile(
    rf"\b(?:(?!(?:{_STOP_WORDS})\b)(?:{_VERBS})|at(?! once| 1 x)|in \d+|when|if|after|before|near|behind"
    r"|until|unless)\b"
)


def is_stop(text: str) -> bool:
    """Whether a line begins with stop and has no other verb and no condition. It never waits for a model."""
    plain = _plain(text)
    return _STOP.match(plain) is not None and _OTHER_IN_STOP.search(_NOUN_IN_STOP.sub("", plain)) is None


def understand(text: str, scene: Scene, done: int | None = None) -> Reading:
    """Read a sentence.

    Args:
        done: of the first reading, after its search: so many commands are left out, and an object that is
            not in view is an error now.

    Raises:
        UnclearError: with the question to the operator.
        GrammarError: a value outside of its range.
    """
    plain = _plain(text)
    if is_stop(plain):
        return Reading((make_command("stop"),))
    intents: list[Command | Question] = []
    clauses, focus = _SPLIT.split(plain), dict[str, Any]()
    if (question := _question(clauses[0], scene)) and len(clauses) == 1:
        return Reading((question,))
    if question or any(_question(words, scene) for words in clauses[1:]):
        if any(map(is_stop, clauses)):
            return Reading((make_command("stop"),))
        raise UnclearError(f"{plain!r}: a question and an order. Say one after the other")
    for words in clauses:
        clause = Clause(words, scene, focus)
        try:
            intent = clause.intent()
        except NotSeenError as missing:
            if done is not None or scene.fault is not None:
                raise UnclearError(_not_seen(words, scene)) from None
            search = make_command("seek", class_name=missing.class_name)
            return Reading((*intents, search), done=len(intents))
        focus = clause.focus
        if isinstance(intent, Question) and len(clauses) > 1:
            continue  # "find the red car", which is in view, "and circle it"
        intents.append(intent)
        if isinstance(intent, Command):
            scene = replace(scene, last=intent)
            if len(intents) > (done or 0):  # flown before the next clause, so the pose there is not known
                scene = replace(scene, yaw_rad=None, altitude_m=None)
    return Reading(tuple(intents[done or 0 :]))


def _plain(text: str) -> str:
    text = (
        re.sub(r"[^\w\s.,;:/°'=-]", " ", unicodedata.normalize("NFC", text).lower())
        .replace("'s", " is")
        .replace("'", "")
    )
    text = re.sub(r"(?<!\d)\.(?!\d)|(?<=\d)\.(?!\d)", " ", text) if text.count(".") else text
    text = " ".join(text.split()).strip(" ,;:")
    text = re.sub(r"\b(take off|launch|lift off) and (?:climb|go up|hover)\b", r"\1", with_numbers(text))
    text = re.sub(r"\bcome down and land\b", "land", text)
    while (shorter := POLITE.sub("", text)) != text:
        text = shorter
    return text


def _not_seen(words: str, scene: Scene) -> str:
    if scene.fault is not None:
        return f"{words!r}: {scene.fault}"
    seen = "; ".join(map(str, scene.objects)) or "nothing"
    return f"{words!r}: no such object is in view. Seen: {seen}. Which one?"


def _question(text: str, scene: Scene) -> Question | None:
    """A question, or None. Only a question `why` may have a verb of a command."""
    nouns = noun_pattern(scene.class_names)
    if re.fullmatch(r"why(?: (?:not|did|do|does|will|can|cant|cannot|wont|didnt|dont|are|is)\b.*)?", text):
        return Question("why_not")
    if re.fullmatch(
        rf"how (?:much|is) (?:the |your )?(?:battery|charge|power){_REST}"
        r"|(?:(?:what is|report) )?(?:the |your )?(?:battery(?: charge| level| state| left)?|charge left)",
        text,
    ):
        return Question("battery")
    if re.fullmatch(
        r"what (?:(?:do|can) you see|are you seeing|is visible)(?: right)?(?: now)?"
        rf"|what is (?:in (?:front(?: of (?:you|us))?|view|sight)|there){_SEEN_REST}|report what you see",
        text,
    ):
        return Question("seen")
    if found := re.fullmatch(
        r"(?:(?:can|do) you see|is there|are there|where (?:is|are)|how far(?: away)? (?:is|are)|how many"
        rf"|any)(?: any| a| an| the)?(?: (?P<choice>{CHOICE}))?(?: (?P<colour>{COLOUR}))? (?P<noun>{nouns})"
        rf"(?(choice)|(?: (?:(?:is|are) )?on the (?P<side>left|right))?){_SEEN_REST}",
        text,
    ):
        names = classes_of(found["noun"], scene.class_names)
        colour = COLOUR_WORDS.get(found["colour"], "")
        return Question("seen", names, colour, found["choice"] or "", found["side"] or "")
    if re.fullmatch(
        rf"(?:how high|how fast|where) are you{_REST}|what are you doing{_REST}"
        r"|(?:what is )?(?:the |your )?(?:state|status)"
        r"|(?:what is )?your (?:altitude|height|speed|position|mode)"
        rf"|are you (?:flying|armed|ready|healthy|ok){_REST}",
        text,
    ):
        return Question("state")
    return None
