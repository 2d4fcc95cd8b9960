"""Adapts a trained meta-policy to a new task, from one demonstration of it.

    python -m emrld_jax.train env=point2d
    python examples/adapt_trained_policy.py --run runs/point2d/emrld-optimal/seed0 --direction 52

The run is one of Point2D; without `--run`, a short one is trained first, for about half a minute on
two cores. The goal is in a direction (degrees) that need not be a training task's.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp

from emrld_jax.runs.cli import run_command, train_config
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.setup import set_up
from emrld_jax.runs.trained import Trained, load_trained
from emrld_jax.sampling.rollouts import collector, episode_returns
from emrld_jax.types import Demos
from envs_jax import Env
from envs_jax.goals import GoalTask, half_circle


def train(iterations: int) -> Trained:
    """A short training, without a run folder."""
    setup = set_up(train_config(["env=point2d", "algo=emrld", "demos=optimal"]))
    state, demos = setup.learner.init(jax.random.key(0)), setup.demos.train
    for i in range(iterations):
        key = jax.random.fold_in(jax.random.key(1), i)
        state, _ = setup.learner.update(state, key, demos.tasks, demos.demos)
    return Trained(setup, state.params, iterations)


def straight_to(env: Env, task: GoalTask) -> Demos:
    """A demonstration: 20 equal steps from the origin to the goal."""
    displacement = jnp.tile(task.goal / 20, (20, 1))  # [20, 2], m
    obs = jnp.cumsum(displacement, axis=0) - displacement  # before each action
    return Demos(obs, jax.vmap(env.to_policy)(displacement), mask=jnp.ones(20))


def main(run: str | None, iterations: int, direction: float) -> int:
    trained = load_trained(run) if run else train(iterations)
    env, learner, adapt = trained.setup.env, trained.setup.learner, trained.setup.config.adapt
    if env.name != "point2d":
        raise ConfigError(f"{run} is a run of {env.name}; this example adapts one of point2d")

    task = half_circle(jnp.array(direction), distance=2.0)
    demo = straight_to(env, task)
    # what makes a task's episodes: here a simulation, and it could be a robot
    collect = jax.jit(
        collector(env, learner.policy, adapt.num_episodes, adapt.discount, adapt.gae_lambda)
    )
    adapted = learner.adapt(trained.params, jax.random.key(0), task, demo, collect)

    for name, params in (("before", trained.params), ("after", adapted.params)):
        episodes = collect(params, jax.random.key(1), task).trajectory
        print(f"return {name} adaptation: {episode_returns(episodes).mean():.1f}")
    action = learner.policy.apply(adapted.params, jnp.zeros(2)).mean
    x, y = env.to_physical(action)
    print(f"first move of the adapted policy: {x:.3f} m, {y:.3f} m")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", help="folder of a run of point2d")
    parser.add_argument("--iterations", type=int, default=60, help="without --run (default 60)")
    parser.add_argument("--direction", type=float, default=52.0, help="degrees (default 52)")
    arguments = parser.parse_args()
    # what can be mended, such as a folder that is no run, is told in one line
    run_command(lambda: main(arguments.run, arguments.iterations, arguments.direction))
