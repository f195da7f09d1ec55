"""One table of the settings file as a frozen value."""

from __future__ import annotations

import ast
import functools
import inspect
import sys
from collections.abc import Mapping
from typing import Any, Self

from pydantic import BaseModel, ConfigDict
from pydantic.fields import FieldInfo

# In a field's annotation: the program sets it, no file, variable or flag does.
NO_KEY = object()


class Section(BaseModel):
    """One table of the file. Values are immutable and never converted from another type.

    The string below a key is its line of help.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with changes, whose values are not checked. Raises KeyError for an unknown name."""
        if unknown := (update or {}).keys() - type(self).model_fields.keys():
            raise KeyError(f"{type(self).__name__} has no {', '.join(sorted(unknown))}")
        return super().model_copy(update=update, deep=deep)

    @classmethod
    def fields_by_key(cls) -> dict[str, FieldInfo]:
        """Return key → its field, in the order of the file."""
        return {name: field for name, field in cls.model_fields.items() if NO_KEY not in field.metadata}

    @classmethod
    def help_texts(cls) -> dict[str, str]:
        """Return key → the string below it; empty if the program is installed without its source.

        Read once for all sections of a file; pydantic (`use_attribute_docstrings`) would read it for each.
        """
        texts: dict[str, str] = {}
        for base in reversed(cls.__mro__):
            if issubclass(base, Section):
                texts |= texts_below_keys(base.__module__).get(base.__name__, {})
        return texts


@functools.cache
def texts_below_keys(module: str) -> dict[str, dict[str, str]]:
    """Return class → key → the string below it in the source."""
    try:
        source = inspect.getsource(sys.modules[module])
    except OSError:
        return {}
    return {
        node.name: {
            key.target.id: " ".join(text.value.value.split())
            for key, text in zip(node.body, node.body[1:], strict=False)
            if isinstance(key, ast.AnnAssign)
            and isinstance(key.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
            and isinstance(text.value.value, str)
        }
        for node in ast.parse(source).body
        if isinstance(node, ast.ClassDef)
    }
