"""Settings declared as dataclass fields: a default, a help text and the values that are allowed.

Needs the standard library alone, so that a robot's computer without JAX can have settings, too.
"""

from __future__ import annotations

import math
from dataclasses import field, fields
from typing import Any


def setting(
    default: Any,
    help: str,  # the word that users of argparse know
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """A dataclass field with a help text and the values that it allows."""
    allowed = {
        "at_least": at_least,
        "above": above,
        "at_most": at_most,
        "below": below,
        "choices": choices,
    }
    metadata = {"help": help, **{k: v for k, v in allowed.items() if v is not None}}
    if isinstance(default, list | dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def allowed_values(metadata: Any) -> str:
    """The values that a setting allows, in words; empty if any."""
    if "choices" in metadata:
        return "one of " + ", ".join(metadata["choices"])
    words = {"at_least": "at least", "above": "above", "at_most": "at most", "below": "below"}
    return " and ".join(
        f"{text} {_number(metadata[k])}" for k, text in words.items() if k in metadata
    )


def _number(value: float) -> str:
    """A bound in words: whole numbers with all their digits."""
    return str(int(value)) if float(value).is_integer() else f"{value:g}"


def check(section: Any, prefix: str = "") -> None:
    """Refuses a settings object with a value that is not allowed.

    Raises:
        ValueError: names the setting, its value and what is allowed.
    """
    for item in fields(section):
        value = getattr(section, item.name)
        for one in value if isinstance(value, list) else [value]:
            if one is not None and not _is_allowed(one, item.metadata):
                words = (_finite(one), allowed_values(item.metadata))
                allowed = ", ".join(filter(None, words))
                raise ValueError(
                    f"{prefix}{item.name}={value} is not allowed: it must be {allowed}"
                )


def _finite(value: Any) -> str:
    return "finite" if isinstance(value, float) and not math.isfinite(value) else ""


def _is_allowed(value: Any, rule: Any) -> bool:
    if "choices" in rule:
        return value in rule["choices"]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return True
    return (
        math.isfinite(value)
        and value >= rule.get("at_least", -math.inf)
        and value > rule.get("above", -math.inf)
        and value <= rule.get("at_most", math.inf)
        and value < rule.get("below", math.inf)
    )
