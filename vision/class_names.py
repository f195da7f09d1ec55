"""Class names as people and files write them, matched with those of a model. The one place that does it."""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Sequence
from functools import lru_cache


@lru_cache(maxsize=4096)
def fold_name(name: str) -> str:
    """A class name without case, spaces, `_` and `-`, its accents composed: equal for names of one class."""
    plain = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
    return "".join(plain.replace("_", " ").replace("-", " ").split())


def class_named(name: str, class_names: Sequence[str]) -> str:
    """The model's spelling of a class name.

    Raises:
        ValueError: no class, or several that differ in case or separators alone; names them, or near ones.
    """
    if name in class_names:
        return name
    found = sorted({each for each in class_names if fold_name(each) == fold_name(name)})
    if len(found) == 1:
        return found[0]
    if found:
        raise ValueError(f"class {name!r} may be {' or '.join(map(repr, found))}: write it as the model does")
    raise ValueError(f"unknown class {name!r}; {near_names(name, class_names)}")


def near_names(name: str, class_names: Sequence[str]) -> str:
    """Known names close to an unknown one, or some of the known ones, as the end of a message."""
    folded = {fold_name(each): each for each in class_names}
    # At 0.6, `launch` is close to `land`.
    near = [folded[each] for each in difflib.get_close_matches(fold_name(name), list(folded), 3, 0.65)]
    if near:
        return f"did you mean {' or '.join(near)}?"
    more = ", …" if len(class_names) > 12 else ""
    return f"known: {', '.join(class_names[:12])}{more}"


def joined_names(pieces: Sequence[str], class_names: Sequence[str]) -> tuple[str, ...]:
    """Names of a list that was split at its commas: those of a class with a comma in its name are joined.

    A piece that is a class by itself is not joined.
    """
    known = {fold_name(each) for each in class_names}
    most = 1 + max((each.count(",") for each in known), default=0)
    names, begin = list[str](), 0
    while begin < len(pieces):
        ends = range(begin + 1, min(begin + most, len(pieces)) + 1)
        end = next((end for end in ends if fold_name(",".join(pieces[begin:end])) in known), begin + 1)
        names.append(",".join(pieces[begin:end]))
        begin = end
    return tuple(names)
