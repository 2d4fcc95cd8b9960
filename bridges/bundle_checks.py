"""What a bundle must say: its layout, and what of it must agree."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from bridges.activations import ACTIVATIONS
from bridges.messages import BridgeError

BOUNDINGS = ("box", "norm")
MAX_WIDTH = 10_000  # units of a layer, observations, actions
LARGEST = 1e15  # of any number


class Rule(NamedTuple):
    """What a value must be."""

    words: str
    holds: Callable[[Any], bool]


def _is_number(x: Any) -> bool:
    return type(x) in (int, float) and abs(x) <= LARGEST


def _is_text(x: Any) -> bool:
    return isinstance(x, str) and x != ""


def _list_of(holds: Callable[[Any], bool], at_least: int = 1) -> Callable[[Any], bool]:
    return lambda x: isinstance(x, list) and at_least <= len(x) <= MAX_WIDTH and all(map(holds, x))


def _is_at_least(least: int) -> Callable[[Any], bool]:
    return lambda x: type(x) is int and least <= x <= LARGEST


def _one_of(*choices: str) -> Rule:
    return Rule(f"one of {', '.join(choices)}", lambda x: x in choices)


def _is_width(x: Any) -> bool:
    return type(x) is int and 1 <= x <= MAX_WIDTH


def _or_null(rule: Rule) -> Rule:
    return Rule(f"{rule.words}, or null", lambda x: x is None or rule.holds(x))


_TEXT = Rule("a text", _is_text)
_TEXTS = Rule("a list of texts", _list_of(_is_text))
_NUMBERS = Rule("a list of numbers", _list_of(_is_number))
_MAPPING = Rule("a mapping", lambda x: isinstance(x, dict))
_FLAG = Rule("true or false", lambda x: isinstance(x, bool))
_POSITIVE = Rule("a number above 0", lambda x: _is_number(x) and x > 0)
_COUNT = Rule("a whole number, at least 0", _is_at_least(0))
_TASK = Rule(
    "a mapping to numbers or lists of numbers",
    lambda x: (
        isinstance(x, dict)
        and len(x) > 0
        and all(_is_number(v) or _NUMBERS.holds(v) for v in x.values())
    ),
)
_ZONE: dict[str, Any] = {
    "goal": Rule("two numbers", lambda x: _NUMBERS.holds(x) and len(x) == 2),
    "reward": _one_of("sparse", "dense"),
    "reward_radius": _POSITIVE,
    "success": _one_of("square", "disc"),
    "success_size": _POSITIVE,
    "arena": _or_null(_POSITIVE),
    "horizon": Rule("a whole number, at least 1", _is_at_least(1)),
}
_LAYOUT: dict[str, Any] = {
    "environment": {"name": _TEXT, "parameters": _MAPPING},
    "task": _TASK,
    "zone": _or_null(Rule("a mapping", lambda x: isinstance(x, dict))),
    "observation": {"names": _TEXTS, "units": _TEXTS},
    "action": {
        "names": _TEXTS,
        "units": _TEXTS,
        "low": _NUMBERS,
        "high": _NUMBERS,
        "bounding": _one_of(*BOUNDINGS),
    },
    "control_period": _POSITIVE,
    "policy": {
        "hidden_sizes": Rule("a list of layers' units", _list_of(_is_width, at_least=0)),
        "activation": _one_of(*ACTIVATIONS),
        "squash": _FLAG,
    },
    "algorithm": _TEXT,
    "settings": _MAPPING,
    "seed": _COUNT,
    "stage": {"recordings": _COUNT, "adapted": _FLAG},
    "provenance": _MAPPING,
}


def check_about(about: Mapping[str, Any]) -> None:
    """Refuses what a bundle says besides its tensors, unless all of it is there and makes sense.

    Raises:
        BridgeError: names what is wrong and what is allowed.
    """
    _check_layout("", about, _LAYOUT)
    if about["zone"] is not None:
        _check_layout("zone.", about["zone"], _ZONE)
    action = about["action"]
    for section, lists in (("observation", ["units"]), ("action", ["units", "low", "high"])):
        number = len(about[section]["names"])
        for name in lists:
            if len(about[section][name]) != number:
                raise BridgeError(f"{section}.{name} must have {number} entries, as names has")
    low, high = action["low"], action["high"]
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise BridgeError(f"action.low={low} must be below action.high={high}")
    if action["bounding"] == "norm" and {*high, *(-x for x in low)} != {high[0]}:
        raise BridgeError(f"action.bounding=norm needs equal bounds, not {low} to {high}")


def check_tensors(about: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> None:
    """Refuses tensors that are not those which the bundle says it has.

    Raises:
        BridgeError: names the tensor, what is wrong and what is allowed.
    """
    expected = _shapes(about)
    for name in sorted(tensors.keys() - expected):
        raise BridgeError(f"tensor {name!r} is not part of a bundle")
    for name in sorted(expected - tensors.keys()):
        raise BridgeError(f"tensor {name!r} is missing")
    steps = tensors["demos/obs"].shape[:1]
    for name, shape in expected.items():
        wanted = (*steps, *shape) if name.startswith("demos/") else shape
        if tensors[name].shape != wanted:
            words = ("N", *shape) if name.startswith("demos/") else shape
            text = ", ".join(map(str, words))
            raise BridgeError(f"tensor {name!r} has shape {tensors[name].shape}, not [{text}]")
        if not np.isfinite(tensors[name]).all():
            raise BridgeError(f"tensor {name!r} holds numbers that are not finite")


def _shapes(about: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """The tensors' shapes; of a demonstration without its number of steps."""
    observations, actions = (len(about[k]["names"]) for k in ("observation", "action"))
    sizes = (observations, *about["policy"]["hidden_sizes"], actions)
    shapes: dict[str, tuple[int, ...]] = {
        "demos/obs": (observations,),
        "demos/action": (actions,),
    }
    for part in ("policy", "meta"):
        for i in range(len(sizes) - 1):
            shapes[f"{part}/layer_{i}/kernel"] = sizes[i : i + 2]
            shapes[f"{part}/layer_{i}/bias"] = sizes[i + 1 : i + 2]
        shapes[f"{part}/log_std"] = (actions,)
    return shapes


def _check_layout(where: str, value: Mapping[str, Any], layout: Mapping[str, Any]) -> None:
    """Refuses a mapping that has not just the layout's entries, each as its rule says."""
    for name in sorted(layout.keys() - value.keys()):
        raise BridgeError(f"{where}{name} is missing")
    for name in sorted(value.keys() - layout.keys()):
        raise BridgeError(f"{where}{name} is not part of a bundle")
    for name, rule in layout.items():
        if isinstance(rule, Rule):
            if not rule.holds(value[name]):
                shown = repr(value[name])[:60]
                raise BridgeError(f"{where}{name} is {shown}; it must be {rule.words}")
        elif isinstance(value[name], dict):
            _check_layout(f"{where}{name}.", value[name], rule)
        else:
            raise BridgeError(f"{where}{name} must be a mapping")
