"""An extension of Griffe: what comments and help texts say about fields is in the API reference.

Shapes and units of fields stand in comments, beside a field or on the lines before it; settings
have help texts. Both go into an "Attributes" section of their class, unless its docstring has one.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from griffe import Attribute, Class, Docstring, ExprCall, Extension, Module


def comment_on(lines: Sequence[str], first: int, last: int) -> str:
    """The comment that goes with a statement; empty if there is none.

    Args:
        lines: of the file.
        first: the statement's first line, from 1.
        last: its last line.
    """
    above: list[str] = []
    for line in reversed(lines[: first - 1]):
        if not line.strip().startswith("#"):
            break
        above.insert(0, line.strip().lstrip("# "))
    beside = [text for line in lines[first - 1 : last] if (text := _trailing(line))]
    return " ".join([*above, *beside])


def _trailing(line: str) -> str:
    """The comment at the end of a line; a # inside a text is none."""
    comment = ""
    with suppress(tokenize.TokenError):  # the line is a part of a longer statement
        for token in tokenize.generate_tokens(io.StringIO(line.strip()).readline):
            if token.type == tokenize.COMMENT:
                comment = token.string.lstrip("# ")
    return comment


def described(attr: Attribute) -> str:
    """A field's or a constant's help text with its default, or its comment; may be empty."""
    if isinstance(attr.value, ExprCall) and str(attr.value.function) == "setting":
        default, text = (str(argument) for argument in attr.value.arguments[:2])
        with suppress(ValueError):  # a text that is put together
            return f"{ast.literal_eval(text)} (default `{default}`)"
    if attr.lineno is None or not isinstance(attr.filepath, Path):
        return ""
    lines = attr.lines_collection[attr.filepath]
    return comment_on(lines, attr.lineno, attr.endlineno or attr.lineno)


class FieldComments(Extension):
    """Describes the fields of classes, and the constants of modules."""

    def on_class_members(self, *, cls: Class, **_: Any) -> None:
        if cls.docstring is None or "Attributes:" in cls.docstring.value:
            return
        rows = [
            f"    {name}: {described(attr) or '-'}"
            for name, attr in cls.attributes.items()
            if attr.annotation is not None and not name.startswith("_")
        ]
        if rows:
            cls.docstring.value += "\n\nAttributes:\n" + "\n".join(rows)

    def on_module_members(self, *, mod: Module, **_: Any) -> None:
        for name, attr in mod.attributes.items():
            if not attr.is_alias and attr.docstring is None and not name.startswith("_"):
                text = described(attr)
                attr.docstring = Docstring(text, parent=attr) if text else None
