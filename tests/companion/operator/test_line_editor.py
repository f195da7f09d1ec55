"""The line that is typed in a console: keys in, text and view out."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.operator.line_editor import LONGEST_LINE, Key, LineEditor, common_beginning
from tests.companion.operator.terminal import screen


def typed(*pieces: str | bytes, history: tuple[str, ...] = ()) -> tuple[LineEditor, list[str | Key]]:
    editor, found = LineEditor("> "), []
    editor.history = history
    for piece in pieces:
        for key in editor.feed(piece.encode() if isinstance(piece, str) else piece):
            found.append(key)
            if key is Key.OLDER:
                editor.older()
    return editor, found


@pytest.mark.parametrize(
    ("keys", "text", "cursor"),
    [
        ("hold", "hold", 4),
        ("hold\x7f\x08", "ho", 2),
        ("hold\x1b[D\x1b[DX", "hoXld", 3),
        ("hold\x1bOD\x1b[3~", "hol", 3),
        ("hold\x01X\x05Y", "XholdY", 6),
        ("hold\x1b[HX\x1b[FY", "XholdY", 6),
        ("hold\x1b[1~X\x1b[4~Y", "XholdY", 6),
        ("seek car\x17dog", "seek dog", 8),
        ("seek car\x15dog", "dog", 3),
        ("seek car\x1b[D\x1b[D\x0b", "seek c", 6),
        ("seek car\x1bb\x1bbX\x1bfY", "XseekY car", 6),
        ("seek car\x1b[1;5DX", "seek Xcar", 6),
        ("ho\x02\x02\x06X", "hXo", 2),
        ("ab\x01\x04", "b", 0),
        ("\x1b[D\x1b[C\x7f\x1b[3~\x17\x15\x0b\x0e", "", 0),
        ("a\x1b[99;99Xb\x1b[200~c", "abc", 3),  # unknown keys
        ("a\x00\x07b", "ab", 2),
    ],
)
def test_keys_edit_the_line(keys: str, text: str, cursor: int) -> None:
    editor, found = typed(keys)
    assert (editor.text, editor.cursor, found) == (text, cursor, [])


def test_lines_end_at_enter_and_characters_may_come_in_pieces() -> None:
    data = "straße\nhold\r".encode()
    editor, found = typed(*(bytes([byte]) for byte in data))
    assert found == ["straße", "hold"]
    assert (editor.text, editor.cursor) == ("", 0)


def test_history_is_recalled_and_the_typed_line_kept() -> None:
    up, down = "\x1b[A", "\x1b[B"
    lines = ("takeoff 3", "hold")
    assert typed("la", up, history=lines)[0].text == "hold"
    assert typed("la", up, up, up, history=lines)[0].text == "takeoff 3"
    assert typed("la", up, up, down, down, down, history=lines)[0].text == "la"
    assert typed(up)[0].text == ""
    editor, found = typed(up, " 2\n", up, history=lines)
    assert found == [Key.OLDER, "hold 2", Key.OLDER]
    assert editor.text == "hold"


def test_tab_and_the_end_are_left_to_the_caller() -> None:
    assert typed("a\t\x04\n\x04")[1] == [Key.COMPLETE, "a", Key.END]


def test_an_endless_line_is_cut() -> None:
    assert len(typed("x" * 2 * LONGEST_LINE)[0].text) == LONGEST_LINE
    assert typed("\x1b[" + "1" * 1000 + "a")[0].text.endswith("a")


@pytest.mark.parametrize(
    ("keys", "columns", "row", "after"),
    [
        ("hold", 20, "> hold", 0),
        ("hold\x1b[D", 20, "> hold", 1),
        ("0123456789", 8, "> 56789", 0),
        ("0123456789\x01", 8, "> 01234", 5),
        ("0123456789\x1b[D\x1b[D", 8, "> 34567", 0),
        ("中文字", 8, "> 文字", 0),
        ("中文字\x02", 20, "> 中文字", 2),
        ("e\u0301x\x02", 20, "> e\u0301x", 1),
    ],
)
def test_view_is_one_row_with_the_cursor_in_it(keys: str, columns: int, row: str, after: int) -> None:
    view = typed(keys)[0].view(columns)
    assert view == row + (f"\x1b[{after}D" if after else "")


@given(
    st.lists(st.one_of(st.sampled_from(["\x1b[A", "\x1b[D", "\x01", "\x17", "\x7f", "\n", "ab"]), st.text()))
)
def test_no_keys_break_the_row(pieces: list[str]) -> None:
    editor = LineEditor("> ")
    for piece in pieces:
        list(editor.feed(piece.encode("utf-8", "surrogatepass")))
        assert 0 <= editor.cursor <= len(editor.text)
        assert editor.text.isprintable()
        assert len(screen(editor.view(30))) == 1


def test_common_beginning() -> None:
    assert common_beginning(["land", "land-on-marker"]) == "land"
    assert common_beginning(["hold"]) == "hold"
    assert common_beginning(["takeoff", "land"]) == ""
