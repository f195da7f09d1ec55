"""Numbers and units in words, as digits with one spelling of each unit."""

from __future__ import annotations

import re
from functools import partial

_SMALL = re.findall(
    r"\w+",
    "zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen "
    "seventeen eighteen nineteen",
)
_TENS = re.findall(r"\w+", "twenty thirty forty fifty sixty seventy eighty ninety")
_VALUES = {word: index for index, word in enumerate(_SMALL)}
_VALUES |= {word: 20 + 10 * index for index, word in enumerate(_TENS)}
_WORD = "|".join(sorted(_VALUES, key=len, reverse=True))
_SPOKEN = re.compile(rf"\b(?:(?:{_WORD}|a hundred|hundred)(?:[ -]|\b)(?:and (?=(?:{_WORD})\b))?)+")
_DIGIT = "|".join(_SMALL[:10])
_DIGITS = re.compile(rf"(?<=\bpoint)((?: (?:{_DIGIT})\b)+)")

# Unit in a sentence → (unit, factor). The first that matches is used.
_UNITS = (
    (r"m/s|met(?:re|er)s? (?:per|a|each) second|metre per second", "m/s", 1.0),
    (r"km/h|kph|kilomet(?:re|er)s? (?:per|an) hour", "m/s", 1 / 3.6),
    (r"kilomet(?:re|er)s?|km", "m", 1000.0),
    (r"centimet(?:re|er)s?|cm", "m", 0.01),
    (r"met(?:re|er)s?|m", "m", 1.0),
    (r"feet|foot|ft", "m", 0.3048),
    (r"seconds?|secs?|s", "s", 1.0),
    (r"minutes?|mins?", "s", 60.0),
    (r"degrees?|deg|°", "deg", 1.0),
    (r"times|laps?|rounds?|turns?|circles?|x", "x", 1.0),
)
_NUMBER = r"(?<![\w.])(-?\d+(?:\.\d+)?)"


def with_numbers(text: str) -> str:
    """A lower-case sentence with its numbers as digits: "two and a half metres" → "2.5 m"."""
    text = re.sub(r"\bhalf (?:a|an) (?=met|minute|sec|lap|turn|circle|kilomet)", "0.5 ", text)
    text = re.sub(r"\ba couple of\b", "2", text)
    text = re.sub(r"\b(?:a |one )?dozen\b", "12", text)
    text = re.sub(r"\b(?:a|one) (minute|second|met(?:re|er)|kilomet(?:re|er)) and a half\b", r"1.5 \1s", text)
    text = _DIGITS.sub(lambda found: "".join(f" {_VALUES[word]}" for word in found[1].split()), text)
    text = _SPOKEN.sub(lambda found: f"{_value(found[0])}{' ' if found[0].endswith(' ') else ''}", text)
    text = re.sub(r"(\d+) point((?: \d)+)\b", lambda found: f"{found[1]}.{found[2].replace(' ', '')}", text)
    text = re.sub(r"(\d+) and a half\b", lambda found: f"{found[1]}.5", text)
    text = re.sub(r"\b(?:an?) (?=(?:met(?:re|er)|minute|second|lap|kilomet(?:re|er))\b)", "1 ", text)
    text = re.sub(r"\bonce\b(?! more)", "1 x", text)
    text = re.sub(r"\btwice\b(?! (?:as|the)\b)", "2 x", text)
    for pattern, unit, factor in _UNITS:
        text = re.sub(
            rf"{_NUMBER}[ -]?(?:{pattern})(?![\w/°])",
            partial(_in_unit, unit, factor),
            text,
        )
    return text


def _in_unit(unit: str, factor: float, found: re.Match[str]) -> str:
    return f"{float(found[1]) * factor:.6g} {unit}"


def _value(words: str) -> int:
    total = 0
    for word in re.findall(rf"{_WORD}|hundred", words):
        if word == "hundred":
            total = max(total, 1) * 100
        else:
            total += _VALUES[word]
    return total
