"""Write the table of checks of `companion doctor`: `python -m tools.check_table`."""

from __future__ import annotations

from pathlib import Path

from companion.doctor.examine import KINDS

FILE = Path(__file__).parents[1] / "docs" / "how-to" / "troubleshooting.md"
HEAD = "| check | finds |\n|---|---|\n"


def table() -> str:
    """Return the table, one row for each kind of check."""
    finds: dict[str, list[str]] = {}
    for kind in KINDS:
        finds.setdefault(kind.name, []).append(kind.finds)
    return HEAD + "".join(f"| {name} | {'; '.join(texts)} |\n" for name, texts in finds.items())


def with_table(text: str) -> str:
    """Return a page with the table of now."""
    before, _, rest = text.partition(HEAD)
    lines = rest.splitlines(keepends=True)
    rows = next((number for number, line in enumerate(lines) if not line.startswith("|")), len(lines))
    return before + table() + "".join(lines[rows:])


if __name__ == "__main__":
    FILE.write_text(with_table(FILE.read_text()))
