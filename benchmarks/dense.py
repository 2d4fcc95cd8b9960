"""Algorithms without demonstrations on dense Point2D: how near 100 meta-iterations bring them.

`python -m benchmarks.dense` trains MAML and ProMP with several settings, and then measures what
keeps them from what the demonstrations return: where the adapted policies come to rest, how far
that is from the goal on the average over adaptations (bias) and around that average (spread, which
more episodes to adapt on make smaller), and what a controller returns that aims so, or perfectly,
with the same noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.jobs import results_of, train_all, write_results
from emrld_jax.meta.adaptation import Adapted
from emrld_jax.policy import Policy, mean_action
from emrld_jax.runs.trained import Trained, load_trained
from emrld_jax.sampling.rollouts import collector, episode, episode_returns
from emrld_jax.study.programs import Program
from emrld_jax.types import Gaussian, Params, Task
from envs_jax import Env

ITERATIONS = 100
SETTINGS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("maml", ("adapt.learning_rate=0.02", "meta.max_kl=0.03")),
    ("maml", ("policy.std=0.2", "adapt.learning_rate=0.004", "meta.max_kl=0.03")),
    ("maml", ("policy.std=0.2", "adapt.learning_rate=0.016", "meta.max_kl=0.03")),
    (
        "maml",
        ("policy.std=0.2", "adapt.learning_rate=0.004", "meta.max_kl=0.03", "adapt.num_steps=2"),
    ),
    ("promp", ("adapt.learning_rate=0.05", "meta.learning_rate=0.003")),
    ("promp", ("policy.std=0.2", "adapt.learning_rate=0.016", "meta.learning_rate=0.003")),
)
ADAPTATIONS = 20  # of each task, each on episodes of its own
EPISODES = (20, 100)  # that an adaptation learns from: as in training, and more


class Aim(NamedTuple):
    """Where the adapted policies come to rest, relative to the goal, in m."""

    rest: np.ndarray  # [M tasks, K adaptations, 2]

    @property
    def bias(self) -> float:
        """Root mean square over tasks of the mean error."""
        return float(np.sqrt(np.mean(np.sum(self.rest.mean(axis=1) ** 2, axis=-1))))

    @property
    def spread(self) -> float:
        """Root mean square distance of an adaptation's rest from its task's mean."""
        centered = self.rest - self.rest.mean(axis=1, keepdims=True)
        return float(np.sqrt(np.mean(np.sum(centered**2, axis=-1))))


def aim(trained: Trained, episodes: int) -> Aim:
    """Adapts to each training task `ADAPTATIONS` times and follows the mean action to its rest."""
    env, learner, part = trained.setup.env, trained.setup.learner, trained.setup.demos.train
    adapt = trained.setup.config.adapt
    collect = collector(env, learner.policy, episodes, adapt.discount, adapt.gae_lambda)

    def rest(key: jax.Array, task: Task, demos: Any) -> jax.Array:
        adapted: Adapted = learner.adapt(trained.params, key, task, demos, collect)
        path = episode(env, mean_action(learner.policy), adapted.params, key, task)
        last = jnp.sum(path.mask).astype(int) - 1
        return path.obs[last] - task.goal

    keys = jax.random.split(jax.random.key(0), ADAPTATIONS)
    # tasks one after another: their episodes at once need much memory
    of_tasks = jax.jit(
        lambda tasks, demos: jax.lax.map(
            lambda one: jax.vmap(rest, in_axes=(0, None, None))(keys, *one), (tasks, demos)
        )
    )
    return Aim(np.asarray(of_tasks(part.tasks, part.demos)))


def controlled_return(env: Env, std: float, rest: np.ndarray) -> float:
    """What a controller returns, on the average, that goes straight to `rest` beside the goal.

    Each step it takes the action that leads there, or as near as one step can, with normal noise.

    Args:
        std: of the noise, in policy units.
        rest: as in `Aim`.
    """

    def controller(target: jax.Array) -> Policy:
        def apply(params: Params, obs: jax.Array) -> Gaussian:
            way = target - obs
            bounded = way / jnp.maximum(1.0, jnp.linalg.norm(way) / 0.1)  # m a step
            mean = env.to_policy(bounded)
            return Gaussian(mean, jnp.full_like(mean, jnp.log(std)))

        return Policy(lambda key: None, apply)

    def once(key: jax.Array, task: Task, rest: jax.Array) -> jax.Array:
        return episode_returns(episode(env, controller(task.goal + rest), None, key, task))

    keys = jax.random.split(jax.random.key(1), rest.shape[1])
    of_tasks = jax.jit(jax.vmap(jax.vmap(once, in_axes=(0, None, 0)), in_axes=(None, 0, 0)))
    return float(np.mean(of_tasks(keys, env.train_tasks(), jnp.asarray(rest))))


def measure(program: Program) -> dict[str, Any]:
    """A row of the table: means over the program's seeds."""
    found = [results_of(folder)["train"]["stages"][-1] for folder in program.folders]
    runs = [load_trained(folder.path) for folder in program.folders]
    setup = runs[0].setup
    returned: Callable[[np.ndarray], float] = partial(
        controlled_return, setup.env, setup.config.policy.std
    )
    aims = {episodes: [aim(run, episodes) for run in runs] for episodes in EPISODES}
    trained_on = aims[EPISODES[0]]
    return {
        "algorithm": program.algo,
        "settings": " ".join(program.settings[2:]),
        "seeds": len(program.seeds),
        "return": float(np.mean([stage["return"] for stage in found])),
        "success": float(np.mean([stage["success"] for stage in found])),
        "return_per_seed": [stage["return"] for stage in found],
        "bias": float(np.mean([a.bias for a in trained_on])),
        "spread": float(np.mean([a.spread for a in trained_on])),
        "spread_with_more_episodes": float(np.mean([a.spread for a in aims[EPISODES[-1]]])),
        "controller_with_this_aim": float(np.mean([returned(a.rest) for a in trained_on])),
        "controller_with_perfect_aim": returned(np.zeros_like(trained_on[0].rest)),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    few, many = EPISODES
    lines = [
        f"| setting | return | success | bias | spread | spread, {many} in place of {few} episodes "
        "| controller with this aim | with perfect aim |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        meters = ("bias", "spread", "spread_with_more_episodes")
        cells = [f"`{row['algorithm']}` `{row['settings']}`"]
        cells += [f"{row['return']:.1f}", f"{row['success']:.0%}"]
        cells += [f"{row[name]:.3f} m" for name in meters]
        cells += [f"{row[f'controller_with_{name}']:.1f}" for name in ("this_aim", "perfect_aim")]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Trains what is missing, measures and writes the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dense", description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/dense"))
    parser.add_argument("--seeds", type=int, default=3, help="of each setting, from 0 on")
    options = parser.parse_args()
    common = ("env.reward=dense", f"meta.iterations={ITERATIONS}")
    programs = [
        Program(
            options.runs / str(k),
            *("point2d", "optimal", algo),
            seeds=tuple(range(options.seeds)),
            settings=(*common, *settings),
        )
        for k, (algo, settings) in enumerate(SETTINGS)
    ]
    train_all(programs)
    done = [program for program in programs if program.finished]
    rows = [measure(program) for program in done]
    write_results("dense-point2d", done, rows, table(rows))


if __name__ == "__main__":
    main()
