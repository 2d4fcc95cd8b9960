"""Settings that the parts take: typed, with a default, a help text and the values they allow.

The same classes are the sections of the command line's configuration: a setting is declared once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from emrld_jax.fields import setting
from emrld_jax.policy import ACTIVATIONS


@dataclass
class PolicySettings:
    """The Gaussian policy."""

    hidden_sizes: list[int] = setting(
        [100, 100], "units of each hidden layer", at_least=1, at_most=10_000
    )
    activation: str = setting("tanh", "the hidden units' function", choices=tuple(ACTIVATIONS))
    std: float = setting(0.5, "standard deviation of an action, in policy units", above=0)
    output_scale: float = setting(1.0, "factor on the last layer's initial weights", above=0)
    start_at_zero: bool = setting(
        False, "make the first mean action 0 at every observation; needs a hidden layer"
    )
    squash: bool = setting(
        False, "let the network see arcsinh of the observation: large numbers saturate no unit"
    )
    learn_std: bool = setting(False, "learn the standard deviation, starting from policy.std")


@dataclass
class AdaptSettings:
    """The inner step: how the policy adapts to one task."""

    num_steps: int = setting(
        1, "gradient steps; each collects its own episodes", at_least=1, at_most=1000
    )
    num_episodes: int = setting(
        20, "episodes that each gradient step collects", at_least=1, at_most=10_000
    )
    learning_rate: float = setting(0.01, "length of a gradient step", at_least=0)
    warm_start_rate: float = setting(
        0.01, "length of EMRLD-WS's first step, on the demonstrations alone", at_least=0
    )
    first_order: bool = setting(
        False, "ignore in the meta-gradient how the step's gradient depends on the parameters"
    )
    discount: float = setting(0.95, "discount of future rewards", at_least=0, at_most=1)
    gae_lambda: float = setting(
        1.0, "lambda of the generalized advantage estimate", at_least=0, at_most=1
    )


@dataclass
class MetaSettings:
    """The outer step: how the meta-parameters learn over all tasks, by TRPO or by gradients."""

    iterations: int = setting(200, "meta-iterations", at_least=1)
    max_kl: float = setting(
        0.01, "largest mean KL divergence of one step, at the adapted policies", above=0
    )
    cg_iterations: int = setting(10, "conjugate-gradient iterations for the direction", at_least=1)
    damping: float = setting(
        1e-5, "multiple of the identity added to the Fisher matrix", at_least=0
    )
    fisher_every: int = setting(
        4, "the Fisher matrix is estimated on each of these steps (1: on all of them)", at_least=1
    )
    backtrack_ratio: float = setting(
        0.5, "factor by which the line search shortens a refused step", above=0, below=1
    )
    max_backtracks: int = setting(15, "step lengths that the line search tries", at_least=1)
    learning_rate: float = setting(
        0.01, "length of a gradient step, for algorithms without TRPO", at_least=0
    )
    gradient_steps: int = setting(
        5, "ProMP's gradient steps on the episodes of one meta-iteration", at_least=1
    )
    clip: float = setting(
        0.3, "ProMP: how far from 1 the ratio of likelihoods counts", above=0, below=1
    )
    kl_penalty: float = setting(
        0.0005, "ProMP: weight of the KL divergence of the policies before adaptation", at_least=0
    )


@dataclass
class Settings:
    """All that an algorithm is assembled from, apart from the environment."""

    w_rl: float = setting(0.2, "weight of the policy gradient in the inner loss", at_least=0)
    w_bc: float = setting(1.0, "weight of the demonstrations in the inner loss", at_least=0)
    policy: PolicySettings = field(default_factory=PolicySettings)
    adapt: AdaptSettings = field(default_factory=AdaptSettings)
    meta: MetaSettings = field(default_factory=MetaSettings)


def numbers(settings: Any, prefix: str = "") -> tuple[str, ...]:
    """The full names of settings that are real numbers: they change no shape, so may be traced."""
    names: list[str] = []
    for item in fields(settings):
        value = getattr(settings, item.name)
        if is_dataclass(value):
            names += numbers(value, f"{prefix}{item.name}.")
        elif item.type in ("float", "float | None"):
            names.append(f"{prefix}{item.name}")
    return tuple(names)


def with_values(settings: Any, values: Mapping[str, Any]) -> Any:
    """A copy of a settings object with some values, by full name, changed; arrays may be traced."""
    for name, value in values.items():
        section, dot, rest = name.partition(".")
        inside = with_values(getattr(settings, section), {rest: value}) if dot else value
        settings = replace(settings, **{section: inside})
    return settings


def value(settings: Any, name: str) -> Any:
    """A setting by its full name."""
    for part in name.split("."):
        settings = getattr(settings, part)
    return settings
