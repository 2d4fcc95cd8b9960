"""The commands' `setting=value` arguments, without Hydra: a robot's computer may not have it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import yaml

from bridges.messages import BridgeError
from emrld_jax.fields import allowed_values, check
from emrld_jax.runs.usage import Leaf, did_you_mean, leaves

Config = TypeVar("Config")


class SettingError(BridgeError):
    """An argument is refused; the message names it and what is allowed."""


def parse(arguments: Sequence[str], defaults: Config) -> Config:
    """The settings with what the arguments change; sections by their full name (`link.peers=..`).

    Raises:
        SettingError: names what is wrong and what is allowed.
    """
    known, values = leaves(defaults), dict[str, Any]()
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals:
            raise SettingError(f"{argument!r} is not of the form setting=value")
        if key not in known:
            hint = did_you_mean(key, tuple(known))
            raise SettingError(f"{argument}: there is no setting {key!r}{hint} (--help lists all)")
        if key in values:
            raise SettingError(f"{argument}: {key} is given twice")
        values[key] = _value(argument, text, known[key], _annotation(defaults, key))
    config = _updated(defaults, values)
    try:
        check_all(config)
    except ValueError as error:
        raise SettingError(str(error)) from error
    return config


def check_all(config: Any, prefix: str = "") -> None:
    """Checks the values of a settings object and of its sections.

    Raises:
        ValueError: names the setting, its value and what is allowed.
    """
    check(config, prefix)
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            check_all(value, f"{prefix}{item.name}.")


def _annotation(config: Any, key: str) -> str:
    section, dot, rest = key.partition(".")
    if dot:
        return _annotation(getattr(config, section), rest)
    return next(str(item.type) for item in fields(config) if item.name == key)


def _value(argument: str, text: str, leaf: Leaf, annotation: str) -> Any:
    if annotation.endswith(" | None") and text == "null":
        return None
    try:
        return _READ[annotation.removesuffix(" | None")](text)
    except (ValueError, TypeError, yaml.YAMLError) as error:
        words = ", ".join(filter(None, (leaf.type_words, allowed_values(leaf.metadata))))
        raise SettingError(f"{argument} is not allowed: it must be {words}") from error


def _bool(text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise ValueError(f"{text} is neither true nor false")
    return text.lower() == "true"


def _list(text: str) -> list[Any]:
    value = yaml.safe_load(text)
    if not isinstance(value, list):
        raise TypeError(f"{text} is no list")
    return value


# by the annotation of the setting: what makes its value of a text
_READ: dict[str, Callable[[str], Any]] = {
    "int": int,
    "float": float,
    "bool": _bool,
    "str": str,  # literally: a path is no YAML
    "list[str]": lambda text: [str(x) for x in _list(text)],
    "list[float]": lambda text: [float(x) for x in _list(text)],
}


def _updated(config: Any, values: dict[str, Any]) -> Any:
    for key, value in values.items():
        section, dot, rest = key.partition(".")
        inside = _updated(getattr(config, section), {rest: value}) if dot else value
        config = replace(config, **{section: inside})
    return config
