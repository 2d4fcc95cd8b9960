"""The settings of `bridges.run` as ROS parameters. Needs no ROS."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from bridges.run_settings import RunConfig
from bridges.settings import parse
from emrld_jax.fields import allowed_values
from emrld_jax.runs.usage import leaves

# Those that mean nothing here: the transport is rclpy, whose middleware has its own configuration
# (ROS_DOMAIN_ID and others), and a simulated robot is a process of its own.
LEFT_OUT = ("robot", "link.domain_id", "link.peers", "link.interface")
SIMULATED = "sim."


class Parameter(NamedTuple):
    """One ROS parameter."""

    name: str
    default: bool | int | float | str
    description: str


def parameters() -> tuple[Parameter, ...]:
    """All of them.

    ROS has no null and no empty list: these are the texts `null` and `[]`, as the command line of
    `bridges.run` has them. What it takes as text may be given as text here, too.
    """
    declared = []
    for name, leaf in leaves(RunConfig()).items():
        if name in LEFT_OUT or name.startswith(SIMULATED):
            continue
        words = ", ".join(filter(None, (leaf.type_words, allowed_values(leaf.metadata))))
        value = leaf.default
        default = as_text(value) if value is None or isinstance(value, list) else value
        declared.append(Parameter(name, default, f"{leaf.metadata['help']} ({words})"))
    return tuple(declared)


def as_text(value: Any) -> str:
    """A parameter's value as the command line takes it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        return value
    return str(value) if isinstance(value, int | float) else json.dumps(list(value))


def config_of(values: Mapping[str, Any]) -> RunConfig:
    """The settings that parameters give.

    Raises:
        SettingError: names what is wrong and what is allowed.
    """
    texts = [f"{name}={as_text(value)}" for name, value in values.items()]
    return parse(texts, RunConfig(robot="rclpy"))
