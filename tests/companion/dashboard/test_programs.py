"""What the tests say is left out where a program is missing."""

from __future__ import annotations

import pytest

from tests.companion.dashboard.programs import TESTS, left_out


@pytest.mark.parametrize("missing", TESTS)
def test_line_names_what_is_left_out_and_how_to_get_it(missing: str) -> None:
    line = left_out({name: name != missing for name in TESTS})
    assert "\n" not in line
    assert TESTS[missing] in line
    assert not any(text in line for name, text in TESTS.items() if name != missing)
    assert "make browser" in line


def test_nothing_is_said_where_all_programs_are() -> None:
    assert left_out(dict.fromkeys(TESTS, True)) == ""
