"""Brings an environment and demonstrations of one's own, and meta-trains on them.

    python examples/own_environment.py

A ferry crosses a river. Where on the far bank it has to land and how fast the river flows differ
from task to task, and it sees neither: it has to be shown. Takes about half a minute on two cores;
`--iterations 5` shows the shape of it in ten seconds.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax import algorithms, demos
from emrld_jax.runs.evaluation import evaluator
from emrld_jax.settings import AdaptSettings, MetaSettings, PolicySettings, Settings
from emrld_jax.types import Demos
from envs_jax.base import State, check_parameters, scale_action, unscale_action


# --8<-- [start:environment]
class Crossing(NamedTuple):
    """What differs between tasks."""

    dock: jax.Array  # [], m downstream of the start
    current: jax.Array  # [], m a step


class Ferry(NamedTuple):
    position: jax.Array  # [2], m: downstream, and across
    t: jax.Array  # [], steps taken


@dataclass(frozen=True)
class River:
    """A ferry that makes 0.1 m a step in each direction at most, plus what the current adds."""

    reward: str = "sparse"  # nothing farther than 0.3 m from the dock; "dense": minus the distance
    horizon: int = 50  # steps

    name: ClassVar[str] = "river"
    observation_names: ClassVar[tuple[str, ...]] = ("downstream", "across")
    observation_units: ClassVar[tuple[str, ...]] = ("m", "m")
    action_names: ClassVar[tuple[str, ...]] = ("downstream", "across")
    action_units: ClassVar[tuple[str, ...]] = ("m", "m")
    action_low: ClassVar[tuple[float, ...]] = (-0.1, -0.1)
    action_high: ClassVar[tuple[float, ...]] = (0.1, 0.1)
    dt: ClassVar[float] = 1.0  # s
    width: ClassVar[float] = 2.0  # m, of the river
    observation_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 2

    def __post_init__(self) -> None:
        check_parameters(self.reward, self.horizon)

    def train_tasks(self) -> Crossing:
        """Four docks for each of three currents; fields [12]."""
        return _every_pair(jnp.array([-1.5, -0.5, 0.5, 1.5]), jnp.array([-0.03, 0.0, 0.03]))

    def test_tasks(self) -> Crossing:
        """Docks and currents between those; fields [6]."""
        return _every_pair(jnp.array([-1.0, 0.0, 1.0]), jnp.array([-0.015, 0.015]))

    def sample_task(self, key: jax.Array) -> Crossing:
        dock_key, current_key = jax.random.split(key)
        dock = jax.random.uniform(dock_key, minval=-1.5, maxval=1.5)
        return Crossing(dock, jax.random.uniform(current_key, minval=-0.03, maxval=0.03))

    def to_physical(self, action: jax.Array) -> jax.Array:
        """A policy's action, about -1 to 1, in meters, and bounded."""
        return jnp.clip(unscale_action(action, self.action_low, self.action_high), -0.1, 0.1)

    def to_policy(self, physical_action: jax.Array) -> jax.Array:
        return scale_action(physical_action, self.action_low, self.action_high)

    def reset(self, key: jax.Array, task: Crossing | None = None) -> State:
        return self.reset_to(jnp.zeros(2), self.sample_task(key) if task is None else task)

    def reset_to(self, obs: jax.Array, task: Crossing) -> State:
        zero = jnp.zeros(())
        metrics = {"success": zero, "diverged": zero}
        return State(Ferry(obs, jnp.zeros((), jnp.int32)), obs, zero, zero, metrics, {}, task)

    def step(self, state: State, action: jax.Array) -> State:
        ferry: Ferry = state.pipeline_state
        drift = jnp.stack([state.task.current, jnp.zeros(())])
        position = ferry.position + self.to_physical(action) + drift
        distance = jnp.linalg.norm(position - jnp.stack([state.task.dock, jnp.array(self.width)]))
        landed = distance <= 0.1
        near = jnp.where(distance <= 0.3, 1.0 - distance, 0.0)
        bonus = (self.horizon - ferry.t - 1).astype(jnp.float32)  # for each step that is left
        sparse = jnp.where(landed, bonus, near)
        done = landed.astype(jnp.float32)
        return replace(
            state,
            pipeline_state=Ferry(position, ferry.t + 1),
            obs=position,
            reward=-distance if self.reward == "dense" else sparse,
            done=done,
            metrics={**state.metrics, "success": done},
        )


def _every_pair(docks: jax.Array, currents: jax.Array) -> Crossing:
    dock, current = jnp.meshgrid(docks, currents)
    return Crossing(dock.reshape(-1), current.reshape(-1))


# --8<-- [end:environment]
# --8<-- [start:demonstrations]
def ferryman(env: River, obs: jax.Array, task: Crossing) -> jax.Array:
    """The action of someone who knows the river: straight to the dock, against the current."""
    way = jnp.stack([task.dock, jnp.array(env.width)]) - obs
    stroke = 0.09 * way / jnp.maximum(jnp.linalg.norm(way), 0.09)
    physical = stroke - jnp.stack([task.current, jnp.zeros(())])
    # an action must be one that the environment executes as it is
    return env.to_policy(env.to_physical(env.to_policy(physical)))


def record(env: River, tasks: Crossing) -> demos.DemoSet:
    """One demonstration a task, with what it achieves."""

    def crossing(task: Crossing) -> Demos:
        def step(carry: tuple[State, jax.Array], _: None) -> tuple[tuple, Demos]:
            state, alive = carry
            action = ferryman(env, state.obs, task)
            following = env.step(state, action)
            return (following, alive * (1.0 - following.done)), Demos(state.obs, action, alive)

        start = (env.reset(jax.random.key(0), task), jnp.ones(()))
        return jax.lax.scan(step, start, None, length=env.horizon)[1]

    recorded = jax.vmap(crossing)(tasks)  # mask 1 up to the landing
    return demos.DemoSet(recorded, tasks, *demos.replay(env, tasks, recorded))


def write_demonstrations(env: River, path: Path) -> None:
    train, test = record(env, env.train_tasks()), record(env, env.test_tasks())
    about = demos.provenance(command="examples/own_environment.py")
    demos.save(path, demos.DemoFile(env.name, "optimal", train, test, about), env)


# --8<-- [end:demonstrations]
# --8<-- [start:training]
def main(iterations: int, path: Path) -> None:
    env = River()
    write_demonstrations(env, path)
    file = demos.load(path, env)  # checks every array
    landed = int(file.train.success.sum())
    print(f"{path}: {landed} of {file.train.success.size} demonstrations land")

    adapt = AdaptSettings(learning_rate=0.005)
    settings = Settings(
        policy=PolicySettings(output_scale=3.0, start_at_zero=True),
        adapt=adapt,
        meta=MetaSettings(max_kl=0.03),
    )
    learner = algorithms.make("emrld", env, settings)
    state = learner.init(jax.random.key(0))
    for i in range(iterations):
        key = jax.random.fold_in(jax.random.key(1), i)
        state, metrics = learner.update(state, key, file.train.tasks, file.train.demos)
        before, after = metrics["adapt/return_0"], metrics["adapt/return_1"]
        print(f"iteration {i + 1}: return {before:.1f} before adaptation, {after:.1f} after")

    evaluate = evaluator(env, learner, adapt, episodes=20)
    result = evaluate(state.params, jax.random.key(2), file.test.tasks, file.test.demos)
    before, after = result.returns.mean(axis=(0, 2))  # [tasks, adaptation steps, episodes]
    print(f"held-out crossings: return {before:.1f} before adaptation, {after:.1f} after")


# --8<-- [end:training]
if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=40, help="meta-iterations (default 40)")
    parser.add_argument("--demos", type=Path, default=Path("demos/river_optimal.npz"))
    arguments = parser.parse_args()
    main(arguments.iterations, arguments.demos)
