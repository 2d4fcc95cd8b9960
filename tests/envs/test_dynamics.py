"""Every environment, step by step against an independent version of its equations."""

from __future__ import annotations

from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from tests.envs.oracles import ORACLES, PointOracle
from tests.envs.steering import DRIFT_GOAL, GOAL_NAMES, state_at, task_of

NUM_STATES = 4000
ROUNDING = 1e-5  # m: closer to a boundary than this, float32 may decide otherwise than float64


def random_goals(
    generator: np.random.Generator, name: str, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Goals [number, 2] and drifts [number] of random tasks, as float32 numbers."""
    angle = generator.uniform(0.0, np.pi, number)
    goals = 2.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    drifts = np.zeros(number)
    if name == "two_wheeled_drift":
        goals, drifts = np.tile(DRIFT_GOAL, (number, 1)), generator.uniform(-0.7, 0.7, number)
    return goals.astype(np.float32), drifts.astype(np.float32)


def random_targets(generator: np.random.Generator, name: str, goals: np.ndarray) -> np.ndarray:
    """Positions [number, 2] where steps shall end: every zone, and both sides of each boundary."""
    number = len(goals)
    anywhere = generator.uniform(-2.7, 2.7, (number, 2))
    success = {"point2d": 0.02, "two_wheeled": 0.2, "two_wheeled_drift": 0.1}[name]
    reward = 0.2 if name == "point2d" else 0.5
    radius = np.select(
        [np.arange(number) % 5 == case for case in range(1, 4)],
        [
            generator.uniform(0.0, 2.0 * success, number),
            generator.uniform(0.0, 1.5 * reward, number),
            reward + generator.uniform(-0.01, 0.01, number),
        ],
    )
    angle = generator.uniform(-np.pi, np.pi, number)
    around = goals + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # The last fifth ends beside the arena's edges.
    edge = np.sign(anywhere) * (2.5 + generator.uniform(-0.02, 0.02, (number, 2)))
    beside = np.where(generator.random((number, 1)) < 0.5, [[1.0, 0.0]], [[0.0, 1.0]])
    at_edge = np.where(beside > 0, edge, anywhere)
    case = np.arange(number)[:, None] % 5
    return np.where(case == 0, anywhere, np.where(case == 4, at_edge, around))


def steered_cases(name: str, seed: int) -> dict[str, np.ndarray]:
    """States, actions and tasks, as float32 numbers, whose next state is in every zone."""
    generator = np.random.default_rng(seed)
    goals, drifts = random_goals(generator, name, NUM_STATES)
    targets = random_targets(generator, name, goals)
    actions = (2.0 * generator.standard_normal((NUM_STATES, 2))).astype(np.float32)
    headings = generator.uniform(-7.0, 7.0, NUM_STATES)
    before = ORACLES[name].before
    obs = [before(*case) for case in zip(targets, headings, actions, strict=True)]
    return {
        "obs": np.array(obs, np.float32),
        "action": actions,
        "goal": goals,
        "drift": drifts,
        "t": generator.integers(0, 100, NUM_STATES),
    }


def expected_steps(name: str, cases: dict[str, np.ndarray]) -> list[Any]:
    columns = [cases[key].astype(np.float64) for key in ("obs", "action", "goal")]
    return [
        ORACLES[name].step(obs, action, goal, float(drift))
        for obs, action, goal, drift in zip(*columns, cases["drift"], strict=True)
    ]


@pytest.mark.parametrize("kind", ["sparse", "dense"])
@pytest.mark.parametrize("name", GOAL_NAMES)
def test_a_step_equals_the_equations_in_every_zone(name: str, kind: str) -> None:
    cases = steered_cases(name, seed=3)
    expected = expected_steps(name, cases)
    env = envs_jax.make(name, reward=kind)
    state = state_at(name, cases["obs"], cases["t"], task_of(name, cases["goal"], cases["drift"]))

    after = jax.jit(jax.vmap(env.step))(state, jnp.asarray(cases["action"]))

    np.testing.assert_allclose(after.obs, [e.obs for e in expected], rtol=1e-6, atol=2e-6)
    np.testing.assert_allclose(after.metrics["distance"], [e.distance for e in expected], atol=2e-6)
    np.testing.assert_array_equal(after.pipeline_state.t, cases["t"] + 1)
    clear = np.array([e.margin > ROUNDING for e in expected])
    assert clear.mean() > 0.99
    rewards = np.array([e.reward(t, kind) for e, t in zip(expected, cases["t"], strict=True)])
    done = np.array([e.done for e in expected])
    success = np.array([e.zone == "success" for e in expected])
    np.testing.assert_allclose(np.asarray(after.reward)[clear], rewards[clear], atol=3e-6)
    np.testing.assert_array_equal(np.asarray(after.done)[clear], done[clear])
    np.testing.assert_array_equal(np.asarray(after.metrics["success"])[clear], success[clear])


@pytest.mark.parametrize("name", GOAL_NAMES)
def test_the_steered_states_visit_every_zone_boundary_and_bonus(name: str) -> None:
    cases = steered_cases(name, seed=3)
    expected = expected_steps(name, cases)

    zones = Counter(e.zone for e in expected)

    wanted = {"success", "near", "far"} | ({"outside"} if name != "point2d" else set())
    assert set(zones) == wanted
    assert min(zones.values()) >= 300
    bonus_steps = {int(t) for e, t in zip(expected, cases["t"], strict=True) if e.zone == "success"}
    assert len(bonus_steps) >= 90
    reward_radius = 0.2 if name == "point2d" else 0.5
    sides = Counter(
        e.distance <= reward_radius for e in expected if abs(e.distance - reward_radius) < 0.01
    )
    assert min(sides[True], sides[False]) >= 200


@pytest.mark.parametrize("name", GOAL_NAMES)
def test_sparse_reward_is_exactly_zero_outside_the_zone(name: str) -> None:
    cases = steered_cases(name, seed=4)
    expected = expected_steps(name, cases)
    far = np.array([e.reward(0, "sparse") == 0.0 and e.margin > ROUNDING for e in expected])
    env = envs_jax.make(name)
    state = state_at(name, cases["obs"], cases["t"], task_of(name, cases["goal"], cases["drift"]))

    rewards = np.asarray(jax.vmap(env.step)(state, jnp.asarray(cases["action"])).reward)[far]

    assert far.sum() > 500
    assert np.all(rewards == 0.0)


@pytest.mark.parametrize("name", GOAL_NAMES)
def test_whole_episodes_follow_the_equations(name: str) -> None:
    """40 episodes of 100 random actions: errors add up over the steps, and must stay rounding."""
    episodes, steps = 40, 100
    generator = np.random.default_rng(7)
    goals, drifts = random_goals(generator, name, episodes)
    actions = generator.standard_normal((steps, episodes, 2)).astype(np.float32)
    env = envs_jax.make(name)
    keys = jax.random.split(jax.random.key(0), episodes)
    first = jax.vmap(env.reset)(keys, task_of(name, goals, drifts))

    def advance(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        after = jax.vmap(env.step)(state, action)
        return after, after.obs

    obs = np.asarray(jax.lax.scan(advance, first, jnp.asarray(actions))[1])

    for episode in range(episodes):
        now = np.zeros(env.observation_size)
        for t in range(steps):
            action = actions[t, episode].astype(np.float64)
            goal = goals[episode].astype(np.float64)
            now = ORACLES[name].step(now, action, goal, float(drifts[episode])).obs
            np.testing.assert_allclose(obs[t, episode], now, rtol=1e-5, atol=1e-4)


def one_step(env: Any, obs: list[float], goal: list[float], t: int = 7) -> Any:
    """Stands still for one step: the policy action that moves nothing."""
    name = env.name
    action = jnp.zeros(2) if name == "point2d" else jnp.array([-1.0, 0.0])
    return env.step(state_at(name, np.array(obs), t, task_of(name, np.array(goal), 0.0)), action)


def above(number: float) -> float:
    """The next float32."""
    return float(np.nextafter(np.float32(number), np.float32(np.inf)))


# All numbers are exact in float32, so a boundary is hit exactly, and then missed by one last bit.
@pytest.mark.parametrize(
    ("x", "reward", "done"),
    [
        (2.25, 92.0, 1.0),  # at the goal radius: success, 100 - 7 - 1
        (above(2.25), 0.75, 0.0),
        (2.5, 0.5, 0.0),  # at the reward radius
        (above(2.5), 0.0, 0.0),
        (2.0, 92.0, 1.0),
    ],
)
def test_point2d_boundaries_belong_to_the_zone(x: float, reward: float, done: float) -> None:
    env = envs_jax.make("point2d", goal_radius=0.25, reward_radius=0.5)

    after = one_step(env, [x, 0.0], [2.0, 0.0])

    assert float(after.reward) == pytest.approx(reward, abs=1e-6)
    assert (float(after.reward) == 0.0) == (reward == 0.0)
    assert float(after.done) == done


@pytest.mark.parametrize("name", ["two_wheeled", "two_wheeled_drift"])
@pytest.mark.parametrize(
    ("dx", "dy", "reward", "done"),
    [
        (0.25, 0.25, 92.0, 1.0),  # the square's corner, farther than 0.25 from the goal
        (-0.25, -0.25, 92.0, 1.0),
        (2.0**-20 + 0.25, 0.25, 1.0 - 0.3535541, 0.0),
        (0.25, 2.0**-20 + 0.25, 1.0 - 0.3535541, 0.0),
        (0.0, -0.5, 0.5, 0.0),  # at the reward radius
        (0.0, -0.5 - 2.0**-20, 0.0, 0.0),
        (-0.5, -0.5, 0.0, 0.0),
    ],
)
def test_wheels_boundaries_belong_to_the_zone(
    name: str, dx: float, dy: float, reward: float, done: float
) -> None:
    env = envs_jax.make(name, goal_half_width=0.25)

    after = one_step(env, [2.0 + dx, 1.0 + dy, 0.3], [2.0, 1.0])

    assert float(after.reward) == pytest.approx(reward, abs=1e-6)
    assert (float(after.reward) == 0.0) == (reward == 0.0)
    assert float(after.done) == done
    assert float(after.metrics["success"]) == done


@pytest.mark.parametrize("name", ["two_wheeled", "two_wheeled_drift"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_arena_includes_its_edge(name: str, sign: float, axis: int) -> None:
    env = envs_jax.make(name)
    inside, outside = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    inside[axis], outside[axis] = sign * 2.5, sign * above(2.5)

    at_edge = one_step(env, inside, [0.0, 2.0])
    beyond = one_step(env, outside, [0.0, 2.0])

    assert float(at_edge.done) == 0.0
    assert float(beyond.done) == 1.0
    assert float(beyond.metrics["success"]) == 0.0


def test_point2d_has_no_arena() -> None:
    assert float(one_step(envs_jax.make("point2d"), [40.0, -7.0], [2.0, 0.0]).done) == 0.0


def run(env: Any, task: Any, action: list[float], steps: int) -> tuple[list[float], list[float]]:
    state = env.reset(jax.random.key(0), task)
    step = jax.jit(env.step)
    rewards, done = [], []
    for _ in range(steps):
        state = step(state, jnp.array(action))
        rewards.append(float(state.reward))
        done.append(float(state.done))
    return rewards, done


def test_point2d_worked_episode() -> None:
    """Straight to (2, 0): 17 steps outside the zone, 0.1 m away after 19, success in the 20th."""
    rewards, done = run(
        envs_jax.make("point2d"), task_of("point2d", np.array([2.0, 0.0]), 0.0), [1.0, 0.0], 20
    )

    assert rewards[:17] == [0.0] * 17
    assert rewards[18] == pytest.approx(0.9, abs=1e-5)
    assert rewards[19] == 80.0
    assert done == [0.0] * 19 + [1.0]


def test_two_wheeled_worked_episode() -> None:
    """0.11 m a step to (2, 0): 1.54 to 1.76 m are near, 1.87 m is success, 2.53 m is outside."""
    env = envs_jax.make("two_wheeled")

    rewards, done = run(env, task_of("two_wheeled", np.array([2.0, 0.0]), 0.0), [1.0, 0.0], 23)

    assert rewards[:13] == [0.0] * 13
    np.testing.assert_allclose(rewards[13:17], [0.54, 0.65, 0.76, 83.0], atol=1e-5)
    assert done[:16] == [0.0] * 16
    assert done[16] == 1.0
    assert done[22] == 1.0


def test_drift_worked_steps() -> None:
    """A step goes along the heading before its turn; the drift is per step, not per second."""
    env = envs_jax.make("two_wheeled_drift")
    state = env.reset(jax.random.key(0), task_of("two_wheeled_drift", DRIFT_GOAL, 0.1))

    first = env.step(state, jnp.array([1.0, 0.0]))
    second = env.step(first, jnp.array([1.0, 0.0]))

    np.testing.assert_allclose(first.obs, [0.075, 0.0, 0.1], atol=1e-7)
    np.testing.assert_allclose(
        second.obs, [0.075 + 0.075 * np.cos(0.1), 0.075 * np.sin(0.1), 0.2], atol=1e-6
    )


def test_drift_is_countered_by_turning() -> None:
    """-0.65 rad a step is 1.3 rad/s against it for half a second, 1.3 / 1.5 in policy units."""
    env = envs_jax.make("two_wheeled_drift")
    state = env.reset(jax.random.key(0), task_of("two_wheeled_drift", DRIFT_GOAL, -0.65))

    for _ in range(10):
        state = env.step(state, jnp.array([1.0, 1.3 / 1.5]))

    np.testing.assert_allclose(state.obs, [0.75, 0.0, 0.0], atol=1e-5)


def test_the_oracle_projects_radially() -> None:
    """The oracle itself, on numbers worked by hand: (0.3, 0.4) m is 0.5 m long."""
    np.testing.assert_allclose(PointOracle().displacement(np.array([3.0, 4.0])), [0.06, 0.08])
    np.testing.assert_allclose(PointOracle().displacement(np.array([0.3, -0.4])), [0.03, -0.04])
