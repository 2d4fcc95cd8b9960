"""Environments of others as families of tasks: a counter, brax's ant, Playground's cheetah."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import envs_jax
from emrld_jax.policy import gaussian_policy
from emrld_jax.sampling.rollouts import collector

DOCS = Path(__file__).parents[2] / "docs" / "environments.md"


class Target(NamedTuple):
    place: jax.Array  # []


@struct.dataclass
class CounterState:
    """What brax's states have, and no more."""

    obs: Any
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]


class Counter:
    """Sums its actions; ends above 2; breaks at -3. Writes into what it is given, as brax does."""

    action_size, observation_size, dt = 1, 1, 0.1

    def reset(self, key: jax.Array) -> CounterState:
        start = 0.01 * jax.random.uniform(key, (1,))
        return CounterState(
            {"state": start}, jnp.zeros(()), jnp.zeros(()), {"steps": jnp.zeros(())}
        )

    def step(self, state: CounterState, action: jax.Array) -> CounterState:
        total = state.obs["state"] + action
        total = jnp.where(total < -2.5, jnp.nan, total)
        state.metrics["steps"] = state.metrics["steps"] + 1
        done = (total[0] > 2).astype(jnp.float32)
        return state.replace(obs={"state": total}, reward=jnp.ones(()), done=done)  # type: ignore[attr-defined]


def counter() -> Any:
    def reward(before: Any, action: jax.Array, after: Any, task: Target) -> jax.Array:
        return -jnp.abs(after.obs["state"][0] - task.place) + action[0]

    def sample(key: jax.Array) -> Target:
        return Target(jax.random.uniform(key))

    tasks = envs_jax.Tasks(Target(jnp.array([1.0, -1.0])), Target(jnp.array([0.5])), sample)
    return envs_jax.from_brax(Counter(), reward, tasks, horizon=4)


def test_the_reward_is_the_tasks() -> None:
    env = counter()
    assert (env.name, env.observation_size, env.action_size, env.dt) == ("counter", 1, 1, 0.1)
    before = env.reset(jax.random.key(0), Target(jnp.array(1.0)))
    after = env.step(before, jnp.array([0.5]))
    place = float(before.obs[0]) + 0.5
    np.testing.assert_allclose(after.obs, [place], rtol=1e-6)
    np.testing.assert_allclose(after.reward, -abs(place - 1.0) + 0.5, atol=1e-6)
    assert float(before.pipeline_state.metrics["steps"]) == 0.0  # what was given is as it was
    np.testing.assert_allclose(env.step(before, jnp.array([7.0])).obs, before.obs + 1.0)  # bounded


def test_its_endings_stay_and_breakdowns_end_too() -> None:
    env, step = counter(), jnp.array([-1.0])
    state = env.reset(jax.random.key(0), Target(jnp.array(0.0)))
    up = state
    for _ in range(3):
        up = env.step(up, -step)
    assert (float(up.done), float(up.metrics["diverged"])) == (1.0, 0.0)
    for _ in range(3):
        last, state = state, env.step(state, step)
    assert (float(state.done), float(state.metrics["diverged"])) == (1.0, 1.0)
    np.testing.assert_array_equal(state.obs, last.obs)
    assert float(state.reward) == 0.0


def test_episodes_are_collected() -> None:
    env = counter()
    policy = gaussian_policy(1, 1, hidden_sizes=(4,))
    params = policy.init(jax.random.key(0))
    rollout = collector(env, policy, 3, 0.95, 1.0)(
        params, jax.random.key(1), env.sample_task(jax.random.key(2))
    )
    assert rollout.trajectory.obs.shape == (3, 4, 1)
    assert np.isfinite(rollout.advantage).all()


def test_what_lacks_the_interface_is_refused() -> None:
    with pytest.raises(TypeError, match=r"object has no reset, step, action_size"):
        envs_jax.from_brax(object(), lambda *_: jnp.zeros(()), counter().tasks)
    with pytest.raises(ValueError, match="counter cannot start from an observation"):
        counter().reset_to(jnp.zeros(1), Target(jnp.zeros(())))


def example(word: str) -> str:
    """The documentation's piece of Python in which a word stands."""
    blocks = [part.split("```")[0] for part in DOCS.read_text().split("```python\n")[1:]]
    (code,) = [text for text in blocks if word in text]
    return code


@pytest.mark.parametrize(
    ("word", "package"), [("get_environment", "brax"), ("registry", "mujoco_playground")]
)
def test_the_examples_of_the_documentation(
    word: str, package: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(package)
    with warnings.catch_warnings(), jax.numpy_rank_promotion("allow"):
        warnings.simplefilter("ignore")  # brax says that nobody maintains it
        exec(example(word), {})
    assert np.isfinite(float(capsys.readouterr().out.split()[-1]))


def test_the_example_of_learning(capsys: pytest.CaptureFixture[str]) -> None:
    exec(example("algorithms.make"), {"env": counter()})
    rows = [[float(x) for x in line.split()] for line in capsys.readouterr().out.splitlines()]
    assert np.shape(rows) == (3, 3)
    assert np.isfinite(rows).all()
