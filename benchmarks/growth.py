"""How the cost of a meta-iteration grows with the work, one size after the other.

`python -m benchmarks.growth env=point2d` times a meta-iteration in which adaptation weighs every
step (dense reward, first parameters), fits a power of each size, and draws both.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from benchmarks.choice import Choice, chosen, origin
from benchmarks.records import write_record
from benchmarks.timing import seconds
from emrld_jax import algorithms
from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.config import algorithm_settings, check_config, make_env
from emrld_jax.runs.setup import Setup, set_up

KEY = jax.random.key(0)

# what grows, and its values; all else stays at the environment's defaults, but for the smaller
# base of those that would take too much memory
SIZES: dict[str, tuple[int, ...]] = {
    "tasks": (12, 24, 48, 96, 192, 384, 768),
    "episodes": (20, 40, 80, 160, 320),
    "horizon": (25, 50, 100, 200, 400),
    "hidden width": (25, 50, 100, 200, 400),
    "inner steps": (1, 2, 3, 4, 5),
}
FITTED = 3  # of the largest values
SMALL = {"tasks": {"episodes": 4}}  # 768 tasks of 20 episodes take more memory than 24 GiB


@dataclass
class GrowthConfig(Choice):
    """All settings of the measurement."""

    repetitions: int = setting(3, "of each measurement", at_least=2)


def changed(setup: Setup, sizes: dict[str, int]) -> tuple[Setup, int]:
    """The set-up with other sizes, and how many tasks."""
    config = setup.config
    wide = sizes.get("hidden width")
    config = replace(
        config,
        env=replace(config.env, horizon=sizes.get("horizon", config.env.horizon)),
        policy=replace(
            config.policy, hidden_sizes=[wide, wide] if wide else config.policy.hidden_sizes
        ),
        adapt=replace(
            config.adapt,
            num_episodes=sizes.get("episodes", config.adapt.num_episodes),
            num_steps=sizes.get("inner steps", config.adapt.num_steps),
        ),
    )
    env = make_env(config.env)
    learner = algorithms.make(config.algo, env, algorithm_settings(config))
    there = setup.demos.train.demos.mask.shape[0]
    return setup._replace(config=config, env=env, learner=learner), sizes.get("tasks", there)


def measure(setup: Setup, tasks: int, repetitions: int) -> list[float]:
    """Seconds of a meta-iteration over so many tasks, which repeat those that there are."""
    part = setup.demos.train
    index = np.arange(tasks) % part.demos.mask.shape[0]
    own, demos = jax.tree.map(lambda x: x[index], (part.tasks, part.demos))
    state = setup.learner.init(jax.random.key(1))
    times = seconds(lambda: setup.learner.update(state, KEY, own, demos), repetitions)
    return [float(t) for t in times]


def fit(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """The exponent and the factor of the power of the size that fits the last medians best."""
    tail = rows[-FITTED:]
    x = np.log([row["value"] for row in tail])
    y = np.log([np.median(row["seconds"]) for row in tail])
    exponent, logarithm = np.polyfit(x, y, 1)
    return float(exponent), float(np.exp(logarithm))


def table(found: dict[str, list[dict[str, Any]]]) -> str:
    """The medians and slopes as Markdown."""
    lines = [
        "| what grows | a meta-iteration, in ms | exponent of the three largest |",
        "|---|---|---|",
    ]
    for what, rows in found.items():
        cells = ", ".join(f"{r['value']}: {1e3 * np.median(r['seconds']):.0f}" for r in rows)
        lines.append(f"| {what} | {cells} | {fit(rows)[0]:.2f} |")
    return "\n".join(lines)


def draw(found: dict[str, list[dict[str, Any]]], title: str, stem: Any) -> None:
    """A panel for each size: medians with their range, and the fitted power."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(3.0 * len(found), 3.2), layout="constrained")
    axes = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for ax, (what, rows) in zip(axes, found.items(), strict=True):
        x = np.array([row["value"] for row in rows], float)
        times = [row["seconds"] for row in rows]
        middle = np.array([np.median(t) for t in times])
        low, high = (np.array([f(t) for t in times]) for f in (min, max))
        ax.errorbar(x, middle, [middle - low, high - middle], fmt="o", capsize=3)
        exponent, factor = fit(rows)
        ax.plot(x, factor * x**exponent, "--", label=f"size^{exponent:.2f}")
        ax.set(xscale="log", yscale="log", xlabel=what, xticks=x)
        ax.set_xticks(x, [f"{v:g}" for v in x])
        ax.minorticks_off()
        ax.legend(frameon=False)
    axes[0].set_ylabel("s a meta-iteration")
    figure.suptitle(title)
    for ending in ("png", "svg"):
        figure.savefig(stem.with_suffix(f".{ending}"), dpi=120)


def main() -> int:
    """Measures, fits, draws and writes."""
    config = cli.updated(GrowthConfig(), cli.parse(sys.argv[1:], GrowthConfig(), {}))
    check_config(config)
    arguments = chosen(config)
    setup = set_up(cli.train_config([*arguments, "env.reward=dense"]))
    found: dict[str, list[dict[str, Any]]] = {what: [] for what in SIZES}
    for what, values in SIZES.items():
        for value in values:
            own, tasks = changed(setup, {**SMALL.get(what, {}), what: value})
            times = measure(own, tasks, config.repetitions)
            found[what].append({"value": value, "seconds": times})
            print(f"{what} {value}: {1e3 * np.median(times):.0f} ms", flush=True)
            jax.clear_caches()
    record = {
        **origin("growth"),
        "smaller": SMALL,
        "rows": [{"what": what, "exponent": fit(r)[0], "rows": r} for what, r in found.items()],
    }
    stem = write_record(f"growth-{config.env}", record, table(found))
    draw(found, f"{config.env}, {config.algo}: what a meta-iteration takes", stem)
    return 0


if __name__ == "__main__":
    cli.run_command(main)
