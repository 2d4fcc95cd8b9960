"""The help text of a command, generated from the settings' classes; hints at what was meant."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from typing import Any, NamedTuple

from emrld_jax.fields import allowed_values

_TYPES = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "a text",
    "list[float]": "a list of numbers, such as [2,1]",
    "list[int]": "a list of whole numbers, such as [100,100]",
    "list[str]": "a list of names, such as [point2d,half_cheetah]",
    "dict[str, list[float]]": "vmap.SETTING=[NUMBER,NUMBER,...]",
}


class Leaf(NamedTuple):
    """One setting."""

    section: type
    name: str  # in its section
    type_words: str
    default: Any
    metadata: Mapping[str, Any]


def leaves(config: Any) -> dict[str, Leaf]:
    """All settings of a settings object by their full name, sections last."""
    flat, nested = {}, {}
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            nested.update({f"{item.name}.{k}": leaf for k, leaf in leaves(value).items()})
        else:
            words = _type_words(str(item.type))
            flat[item.name] = Leaf(type(config), item.name, words, value, item.metadata)
    return {**flat, **nested}


def usage(
    command: str,
    purpose: str,
    examples: Sequence[str],
    defaults: Any,
    groups: Mapping[str, Sequence[str]],
    operands: str = "",
) -> str:
    """The help text: every setting with its type, default, meaning and allowed values.

    Args:
        command: the module's full name.
        purpose: what the command does.
        examples: what may follow the command.
        defaults: the settings.
        groups: names of files of defaults, by group.
        operands: what stands before the settings, such as RUNS...
    """
    form = " ".join(filter(None, (command, operands, "[setting=value ...]")))
    lines = [purpose, "", f"Usage: python -m {form}", "", "Examples:"]
    lines += [f"  python -m {command} {example}" for example in examples]
    if groups:
        lines += ["", "Groups (each a file of defaults in emrld_jax/conf):"]
        lines += [f"  {group}=NAME  one of {', '.join(names)}" for group, names in groups.items()]
    lines += ["", "Settings:"]
    section = ""
    for key, leaf in leaves(defaults).items():
        if key == "env.name":  # chosen by the group
            continue
        if "." in key and key.split(".")[0] != section:
            section = key.split(".")[0]
            lines += ["", f" {section}: {leaf.section.__doc__}"]
        lines += _describe(key, leaf)
    return "\n".join(lines)


def did_you_mean(wrong: str, known: Sequence[str]) -> str:
    """A hint at the closest known name; empty if none is close."""
    lower = {name.lower(): name for name in known}
    close = [lower[c] for c in get_close_matches(wrong.lower(), lower, n=1, cutoff=0.5)]
    if not close:  # the right name in the wrong section
        _, _, last = wrong.rpartition(".")
        close = [name for name in known if name.endswith(f".{last}")][:1]
    return f"; did you mean {close[0]!r}?" if close else ""


def _describe(key: str, leaf: Leaf) -> list[str]:
    allowed = ", ".join(filter(None, (leaf.type_words, allowed_values(leaf.metadata))))
    text = f"{leaf.metadata['help']} ({allowed})"
    body = textwrap.wrap(text, 92, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return [f"  {key}={_as_typed(leaf.default)}", *body]


def _as_typed(value: Any) -> str:
    """A value as the command line takes it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value).replace(" ", "")


def _type_words(annotation: str) -> str:
    optional = annotation.endswith(" | None")
    words = _TYPES[annotation.removesuffix(" | None")]
    return f"{words}, or null" if optional else words
