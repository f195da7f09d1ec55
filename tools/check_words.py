"""Words that this project does not use, with the term to use instead. `make lint` runs it.

    python -m tools.check_words [FILE ...]

Every Python, Markdown, JavaScript, HTML and TOML file that git knows is read: identifiers (split at `_` and
at capitals), comments, docstrings, messages and prose. The exit code is 1 where a word is found.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

INSTEAD = {
    "anew": "again, new",
    "cockpit": "harness",
    "errand": "request",
    "film": "video",
    "films": "videos",
    "flock": "fleet",
    "hear": "receive",
    "heard": "received",
    "hears": "receives",
    "keeper": "supervisor",
    "lest": "so that ... not",
    "manners": "profile",
    "picture": "image, frame",
    "pictures": "images, frames",
    "refusal": "error, rejection, denial",
    "refusals": "errors, rejections, denials",
    "stranger": "other, unknown",
    "strangers": "others, unknown",
    "tell": "report, publish, log, send, show",
    "telling": "reporting, publishing, logging",
    "tells": "reports, publishes, logs, sends, shows",
    "told": "reported, published, logged, sent, shown",
    "whom": "(rephrase)",
}
PHRASES = {
    "counts as true": "is confirmed",
    "count as true": "be confirmed",
    "under way": "in progress",
    r"being flown": "active",
    r"for ever\b": "forever, until cancelled",
    r"what is flown|nothing is flown": "the active behaviour; nothing is executed",
    "what flies": "the active behaviour, the vehicle",
}
# Names of others: of a library, and of a file format's key.
ALLOWED = ("fcntl.flock", ".tell()", "def tell(self)")

_WORDS = re.compile(r"(?<![A-Za-z])(" + "|".join(INSTEAD) + r")(?![a-z])", re.IGNORECASE)
_CAPITALS = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


def findings(text: str) -> Iterator[tuple[int, str, str]]:
    """(line number from 1, the word found, what to say instead)."""
    for number, line in enumerate(text.splitlines(), 1):
        for allowed in ALLOWED:
            line = line.replace(allowed, "")
        for match in _WORDS.finditer(_CAPITALS.sub("_", line)):
            yield number, match[0], INSTEAD[match[0].lower()]
        for phrase, instead in PHRASES.items():
            if found := re.search(phrase, line, re.IGNORECASE):
                yield number, found[0], instead


def main(arguments: Sequence[str]) -> int:
    """The command line. Returns the exit code."""
    patterns = ("*.py", "*.md", "*.js", "*.html", "*.toml")
    known = subprocess.run(
        ["git", "ls-files", "-z", *patterns], check=True, capture_output=True, text=True
    ).stdout.split("\0")
    skipped = {"tools/check_words.py", "tests/tools/test_check_words.py", "CHANGELOG.md"}
    paths = list(arguments) or [path for path in known if path and path not in skipped]
    found = 0
    for path in paths:
        if not Path(path).is_file():
            continue
        for number, word, instead in findings(Path(path).read_text(encoding="utf-8")):
            print(f"{path}:{number}: {word!r}; say: {instead}")
            found += 1
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
