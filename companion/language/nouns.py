"""The nouns of objects: the detector's classes, their plurals and everyday names; words for colours."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence

# Everyday name → classes of COCO and of the bundled model. Those that the detector lacks are left out.
_PEOPLE = "people man men woman women human humans someone somebody anyone anybody pedestrian pedestrians"
SYNONYMS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(_PEOPLE.split(), ("person",)),
    **dict.fromkeys(("vehicle", "vehicles"), ("car", "truck", "bus")),
    **dict.fromkeys(("animal", "animals"), ("dog", "cat", "horse", "sheep", "cow", "bird")),
    **dict.fromkeys(("bike", "bikes"), ("bicycle",)),
    **dict.fromkeys(("automobile", "sedan"), ("car",)),
    **dict.fromkeys(("lorry", "lorries"), ("truck",)),
    **dict.fromkeys(("ship", "ships"), ("boat",)),
    **dict.fromkeys(("motorbike", "motorbikes"), ("motorcycle",)),
}
COLOUR_WORDS = {
    name: name
    for name in (
        "black",
        "white",
        "grey",
        "red",
        "orange",
        "yellow",
        "green",
        "blue",
        "purple",
        "pink",
        "brown",
    )
} | {"gray": "grey", "silver": "grey", "violet": "purple"}


def noun_pattern(class_names: Sequence[str]) -> str:
    """A pattern of every known noun, the longest first."""
    nouns = {form for name in class_names for form in _forms(name)}
    nouns |= {word for word, names in SYNONYMS.items() if set(names) & set(class_names)}
    return "|".join(map(re.escape, sorted(nouns, key=len, reverse=True))) or "(?!)"


def classes_of(noun: str, class_names: Sequence[str]) -> tuple[str, ...]:
    """The detector's classes that a noun may mean; empty: none."""
    exact = tuple(name for name in class_names if noun in _forms(name))
    return exact or tuple(name for name in SYNONYMS.get(noun, ()) if name in class_names)


def _forms(class_name: str) -> tuple[str, ...]:
    """A class in the singular and the plural, lower case."""
    name = " ".join(re.split(r"[\s_-]+", unicodedata.normalize("NFC", class_name).lower()))
    if name.endswith(("s", "sh", "ch", "x")):
        return name, f"{name}es"
    if re.search(r"[^aeiou]y$", name):
        return name, f"{name[:-1]}ies"
    return name, f"{name}s"
