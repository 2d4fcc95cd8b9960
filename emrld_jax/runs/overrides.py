"""Arguments of a command, `setting=value` each: known, of the right type, or a clear message."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from emrld_jax.fields import allowed_values
from emrld_jax.runs.config import PATHS, VARIED, ConfigError
from emrld_jax.runs.usage import Leaf, did_you_mean, leaves

VMAP = "vmap."  # before the name of a setting: values that are trained side by side

Values = dict[str, Any]


def parse(arguments: Sequence[str], schema: Any, options: dict[str, tuple[str, ...]]) -> Values:
    """Values by setting or group, each known and of the right type.

    Args:
        arguments: `key=value` each.
        schema: a settings object.
        options: what each configuration group offers.

    Raises:
        ConfigError: names what is wrong and what is allowed.
    """
    known = leaves(schema)
    values: Values = {}
    for argument in arguments:
        key, value = _parse_one(argument)
        if key in values:
            raise ConfigError(f"{argument}: {key} is given twice")
        if key in options:
            _check_option(key, value, options[key])
        elif key.startswith(VMAP) and "vmap" in known:
            _check_varied(argument, key, value, known)
        else:
            _check_setting(argument, key, value, known, tuple(options))
        values[key] = value
    return values


def _parse_one(argument: str) -> tuple[str, Any]:
    """The name and the value of an argument."""
    key, equals, text = argument.partition("=")
    if key in PATHS and equals:
        return key, None if text == "null" else text
    override = _parse_override(argument)
    return override.key_or_group, override.value()


def _parse_override(argument: str) -> Override:
    try:
        override = OverridesParser.create().parse_override(argument)
    except HydraException as error:
        raise ConfigError(
            f"{argument!r} is not of the form setting=value, without dashes or spaces "
            "(--help lists the settings)"
        ) from error
    if override.type is not OverrideType.CHANGE or override.package is not None:
        raise ConfigError(f"{argument!r}: only the form setting=value is allowed")
    if override.is_sweep_override():
        raise ConfigError(
            f"{argument!r}: one value at a time (quote a text with a comma; a list is [1,2]); for "
            "several seeds num_seeds, for several values vmap or python -m emrld_jax.sweep"
        )
    return override


def _check_option(group: str, value: Any, offered: tuple[str, ...]) -> None:
    if value not in offered:
        hint = did_you_mean(str(value), offered)
        raise ConfigError(f"{group}={value} is unknown{hint} (there are: {', '.join(offered)})")


def _check_setting(
    argument: str, key: str, value: Any, known: dict[str, Leaf], option_names: tuple[str, ...]
) -> None:
    if key == "env.name":
        raise ConfigError(f"{argument}: choose an environment by env={value}, with its defaults")
    if key not in known:
        inside = [name for name in known if name.startswith(f"{key}.")]
        if inside:
            raise ConfigError(f"{argument}: {key} is a section; its settings: {', '.join(inside)}")
        hint = did_you_mean(key, (*known, *option_names))
        raise ConfigError(f"{argument}: there is no setting {key!r}{hint} (--help lists all)")
    leaf = known[key]
    if "choices" in leaf.metadata:
        for one in value if isinstance(value, list) else [value]:
            _check_option(key, one, leaf.metadata["choices"])
    if key in PATHS and value == "":
        raise ConfigError(f"{argument} is not allowed: a path must not be empty")
    if key in PATHS and value is not None:
        return  # any text
    if isinstance(value, str) and (value == "???" or "${" in value):
        raise ConfigError(f"{argument}: ??? and ${{..}} are not allowed; give the value itself")
    try:
        OmegaConf.update(OmegaConf.structured(leaf.section), leaf.name, value)
    except OmegaConfBaseException as error:
        allowed = ", ".join(filter(None, (leaf.type_words, allowed_values(leaf.metadata))))
        raise ConfigError(f"{argument} is not allowed: it must be {allowed}") from error


def _check_varied(argument: str, key: str, value: Any, known: dict[str, Leaf]) -> None:
    """Refuses what cannot be trained side by side."""
    name = key.removeprefix(VMAP)
    if name not in known:
        hint = did_you_mean(name, VARIED)
        raise ConfigError(f"{argument}: there is no setting {name!r}{hint} (--help lists all)")
    if name not in VARIED:
        raise ConfigError(
            f"{argument}: {name} cannot differ between runs of one program; these numbers can: "
            f"{', '.join(VARIED)}. For others: python -m emrld_jax.sweep {name}=VALUE,VALUE"
        )
    is_list = isinstance(value, list) and len(value) > 0
    if not is_list or not all(type(x) in (int, float) for x in value):
        raise ConfigError(f"{argument} is not allowed: it must be a list of numbers, as [0.2,0.5]")
    if len(set(value)) < len(value):
        raise ConfigError(f"{argument} is not allowed: a value is given twice")
