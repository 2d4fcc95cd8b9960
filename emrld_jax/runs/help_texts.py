"""The help texts of training and evaluation, with the values that the other arguments give."""

from __future__ import annotations

from collections.abc import Sequence

from emrld_jax.runs.cli import evaluate_config, groups, parse, train_config
from emrld_jax.runs.config import EvaluateConfig
from emrld_jax.runs.saved import updated
from emrld_jax.runs.usage import usage

HELP = ("-h", "--help", "help")


def asks_for_help(arguments: Sequence[str]) -> bool:
    """Whether the arguments ask what the settings are."""
    return any(argument in HELP for argument in arguments)


def train_usage(arguments: Sequence[str] = ()) -> str:
    """The help text of `emrld_jax.train`, with the values that the other arguments give."""
    return usage(
        "emrld_jax.train",
        "Meta-train a policy with demonstrations; writes a run folder.",
        _examples("train"),
        train_config(_without_help(arguments)),
        groups(),
    )


def evaluate_usage(arguments: Sequence[str] = ()) -> str:
    """The help text of `emrld_jax.evaluate`, with the values that the other arguments give."""
    others = _without_help(arguments)
    values = parse(others, EvaluateConfig(), {})
    return usage(
        "emrld_jax.evaluate",
        "Evaluate a run's policy after 0, 1, .. adaptation steps; writes into the run folder.\n"
        "What is not given of adapt is the run's own, which run=RUN_DIR --help shows.",
        _examples("evaluate"),
        evaluate_config(others) if values.get("run") else updated(EvaluateConfig(), values),
        {},
    )


def _without_help(arguments: Sequence[str]) -> list[str]:
    return [argument for argument in arguments if argument not in HELP]


def _examples(command: str) -> tuple[str, ...]:
    return {
        "train": (
            "env=point2d",
            "env=two_wheeled algo=emrld_ws demos=suboptimal seed=3 meta.iterations=100",
            "env=point2d experiment=paper adapt.num_steps=2 meta.max_kl=0.02",
            "env=two_wheeled num_seeds=4 vmap.w_rl=[0.2,0.6,1.0] processes=2",
            "resume=runs/point2d/emrld-optimal/seed0 meta.iterations=300",
        ),
        "evaluate": (
            "run=runs/point2d/emrld-optimal/seed0",
            "run=runs/point2d/emrld-optimal/seed0 tasks=test adapt.num_steps=3 episodes=100",
        ),
    }[command]
