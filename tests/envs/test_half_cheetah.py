"""HalfCheetah: against MuJoCo in C stepped by hand, Gymnasium, and worked numbers."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs_jax
from emrld_jax import algorithms
from emrld_jax.meta.side_by_side import make_mesh, side_by_side
from emrld_jax.policy import gaussian_policy
from emrld_jax.sampling.rollouts import collector
from emrld_jax.settings import AdaptSettings, PolicySettings, Settings
from emrld_jax.types import Demos
from envs_jax.half_cheetah import CheetahTask, HalfCheetah
from envs_jax.physics import SlowBackendWarning, pack
from envs_jax.physics.engine import Engine
from envs_jax.physics.mjx import Mjx, in_flat_batches
from envs_jax.physics.models import (
    RECORDED,
    ModelChangedWarning,
    check_installed,
    fingerprint,
    load_model,
    silent_mujoco,
)

STATES = 60
FORWARD, BACKWARD = CheetahTask(jnp.array(1.0)), CheetahTask(jnp.array(-1.0))


@cache
def model() -> Any:
    return load_model("half_cheetah")


@cache
def engine() -> Engine:
    return Engine(model(), 5)


@cache
def mjx() -> Mjx:
    return Mjx(model(), 5, 4, 4)


@cache
def advance_all(physics: Callable[[], Any]) -> Callable[..., Any]:
    """Advances bodies [STATES, 27] by torques [STATES, 6]; compiled once for all tests."""
    return jax.jit(jax.vmap(physics().advance))


@cache
def lively_bodies() -> tuple[Any, Any]:
    """Bodies of cheetahs that have moved at random for a while, [STATES, 27], and torques."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model())
    data.qpos[:] = rng.uniform(-0.1, 0.1, 9)
    bodies: list[np.ndarray] = []
    torques: list[np.ndarray] = []
    for _ in range(STATES):
        torque = rng.uniform(-1, 1, 6).astype(np.float32)
        bodies.append(np.concatenate([data.qpos, data.qvel, np.zeros(9)]))
        torques.append(torque)
        for _ in range(15):
            data.ctrl[:] = torque
            mujoco.mj_step(model(), data)
    return np.array(bodies, np.float32), np.array(torques, np.float32)


def by_hand(body: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Positions and velocities after five physics steps of MuJoCo, one simulation, float64."""
    data = mujoco.MjData(model())
    data.qpos[:], data.qvel[:] = body[:9], body[9:18]
    data.qacc_warmstart[:], data.ctrl[:] = body[18:], torque
    for _ in range(5):
        mujoco.mj_step(model(), data)
    return np.concatenate([data.qpos, data.qvel])


def test_the_engine_steps_as_mujoco_does() -> None:
    bodies, torques = lively_bodies()
    after = advance_all(engine)(bodies, torques)
    expected = np.stack([by_hand(b, a) for b, a in zip(bodies, torques, strict=True)])
    assert np.abs(expected - bodies[:, :18]).max() > 1.0  # they move
    np.testing.assert_allclose(after.body[:, :18], expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(after.diverged, 0.0)


def test_mjx_is_near_mujoco_in_c() -> None:
    """But for rare steps whose contacts turn on a hair; docs/half_cheetah.md has distributions."""
    bodies, torques = lively_bodies()
    after = advance_all(mjx)(bodies, torques)
    expected = np.stack([by_hand(b, a) for b, a in zip(bodies, torques, strict=True)])
    worst = np.abs(np.asarray(after.body)[:, :18] - expected).max(axis=1)
    assert np.median(worst) < 1e-4
    assert np.percentile(worst, 90) < 1e-2
    np.testing.assert_array_equal(after.diverged, 0.0)


def test_results_do_not_depend_on_threads_or_neighbors() -> None:
    bodies, torques = lively_bodies()
    one, two = (
        jax.vmap(Engine(model(), 5, threads=n).advance)(bodies, torques).body for n in (1, 2)
    )
    np.testing.assert_array_equal(one, two)
    alone = engine().advance(bodies[7], torques[7]).body
    np.testing.assert_array_equal(alone, one[7])
    grid = jax.vmap(jax.vmap(engine().advance))(
        bodies.reshape(6, 10, 27), torques.reshape(6, 10, 6)
    ).body
    np.testing.assert_array_equal(grid.reshape(STATES, 27), one)


@pytest.mark.parametrize("physics", [engine, mjx], ids=["mujoco", "mjx"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12])
def test_a_simulation_that_breaks_down_stays_where_it_was(physics: Any, bad: float) -> None:
    bodies, torques = lively_bodies()
    broken = bodies.copy()
    broken[3, 9] = bad
    advance = advance_all(physics)
    with np.errstate(invalid="ignore", over="ignore"):
        after, fine = advance(broken, torques), advance(bodies, torques)
    np.testing.assert_array_equal(after.diverged, np.arange(STATES) == 3)
    np.testing.assert_array_equal(after.body[3], broken[3])
    others = np.arange(STATES) != 3
    np.testing.assert_array_equal(after.body[others], fine.body[others])


@pytest.mark.parametrize("physics", [engine, mjx], ids=["mujoco", "mjx"])
def test_a_torque_that_is_no_number_breaks_one_simulation(physics: Any) -> None:
    bodies, torques = lively_bodies()
    bad = torques.copy()
    bad[3, 0] = np.nan
    after, fine = advance_all(physics)(bodies, bad), advance_all(physics)(bodies, torques)
    np.testing.assert_array_equal(after.diverged, np.arange(STATES) == 3)
    np.testing.assert_array_equal(after.body[3], bodies[3])
    others = np.arange(STATES) != 3
    np.testing.assert_array_equal(after.body[others], fine.body[others])


def test_a_function_sees_one_batch_axis_and_not_too_much_of_it() -> None:
    """On a CPU, 3 x 5 x 17 = 255 elements are more than it takes at once."""
    seen = []

    def scaled(x: jax.Array, factor: jax.Array) -> jax.Array:
        seen.append(x.shape)
        return jnp.sum(factor * x)

    x = np.arange(3 * 5 * 17 * 2, dtype=np.float32).reshape(3, 5, 17, 2)
    factor = np.arange(5, dtype=np.float32)
    function = in_flat_batches(scaled)
    inner = jax.vmap(function, in_axes=(0, None))
    result = jax.vmap(jax.vmap(inner), in_axes=(0, None))(x, factor)
    np.testing.assert_allclose(result, x.sum(axis=-1) * factor[:, None], rtol=1e-6)
    assert set(seen) == {(2,)}  # written for one element
    np.testing.assert_allclose(function(x[0, 1, 2], factor[1]), x[0, 1, 2].sum())


def test_nothing_is_written_where_we_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo writes its warnings to a file there unless somebody takes them."""
    monkeypatch.chdir(tmp_path)
    before = mujoco.get_mju_user_warning()
    engine().advance(jnp.full(27, jnp.nan), jnp.zeros(6))
    assert list(tmp_path.iterdir()) == []
    assert mujoco.get_mju_user_warning() is before


def test_a_breakdown_ends_the_episode_without_reward() -> None:
    env = HalfCheetah(reward="dense")
    state = env.reset(jax.random.key(0), FORWARD)
    body = state.pipeline_state.body.at[9].set(1e12)
    fast = replace(state, pipeline_state=state.pipeline_state._replace(body=body))
    after = env.step(fast, jnp.ones(6))
    assert (float(after.done), float(after.reward)) == (1.0, 0.0)
    assert float(after.metrics["diverged"]) == 1.0


def test_the_observation_is_gymnasiums_and_the_torsos_center() -> None:
    with silent_mujoco():
        gym: Any = gymnasium.make("HalfCheetah-v5").unwrapped
        gym.reset(seed=0)
    env = HalfCheetah(reward="dense")
    rng = np.random.default_rng(1)
    state = env.reset(jax.random.key(3), BACKWARD)
    gym.set_state(np.float64(env.positions(state.obs)), np.float64(state.obs[8:17]))
    for _ in range(5):
        action = rng.normal(size=6)  # unbounded, as a policy's; Gymnasium's engine bounds it, too
        x = gym.data.qpos[0]
        state = env.step(state, jnp.asarray(action, jnp.float32))
        expected, _, _, _, info = gym.step(action)
        np.testing.assert_allclose(state.obs[:17], expected, rtol=1e-4, atol=1e-4)
        center = [gym.data.qpos[0], 0.0, 0.7 + gym.data.qpos[1]]
        np.testing.assert_allclose(state.obs[17:], center, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(center[0] - x, 0.05 * info["x_velocity"], rtol=1e-6)
        cost = 0.05 * np.sum(np.clip(action, -1, 1) ** 2)
        np.testing.assert_allclose(state.reward, -info["x_velocity"] - cost, rtol=1e-3, atol=1e-3)


def test_resets_are_near_rest_and_follow_the_distributions() -> None:
    env = HalfCheetah()
    keys = jax.random.split(jax.random.key(0), 4000)
    obs = jax.vmap(lambda key: env.reset(key, FORWARD).obs)(keys)
    positions = np.asarray(env.positions(obs))
    assert np.abs(positions).max() <= 0.1
    np.testing.assert_allclose(positions.std(axis=0), 0.1 / np.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(jnp.std(obs[:, 8:17], axis=0), 0.1, rtol=0.05)
    np.testing.assert_allclose(obs[:, 19], 0.7 + positions[:, 1], atol=1e-6)


@pytest.mark.parametrize("task", [FORWARD, BACKWARD], ids=["forward", "backward"])
@pytest.mark.parametrize(
    ("way", "rewarded"), [(1.9, False), (2.1, True), (-1.9, False), (-2.1, True)]
)
def test_reward_begins_two_meters_from_the_start_on_either_side(
    task: CheetahTask, way: float, rewarded: bool
) -> None:
    """The sign of the reward is the direction's; success is the right side alone."""
    sparse, dense = (HalfCheetah(reward=reward) for reward in ("sparse", "dense"))
    start = sparse.reset(jax.random.key(0), task)
    physical = start.pipeline_state
    moved = replace(start, pipeline_state=physical._replace(body=physical.body.at[0].add(way)))
    action = jnp.full(6, 0.5)
    after, full = sparse.step(moved, action), dense.step(moved, action)
    velocity = (after.obs[17] - start.obs[17] - way) / 0.05
    expected = float(task.direction) * velocity - 0.05 * 6 * 0.25
    np.testing.assert_allclose(full.reward, expected, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(after.reward, full.reward if rewarded else 0.0)
    assert float(after.metrics["success"]) == float(rewarded and way * float(task.direction) > 0)
    assert float(after.done) == 0.0


def test_an_episode_can_begin_where_one_was_observed() -> None:
    env = HalfCheetah()
    state = env.reset(jax.random.key(5), FORWARD)
    again = env.reset_to(state.obs, FORWARD)
    np.testing.assert_allclose(again.pipeline_state.body, state.pipeline_state.body, atol=1e-7)
    np.testing.assert_allclose(again.obs, state.obs, atol=1e-7)


def test_tasks_take_turns() -> None:
    env = HalfCheetah()
    np.testing.assert_array_equal(env.train_tasks().direction, [1, -1] * 5)
    np.testing.assert_array_equal(env.test_tasks().direction, [1, -1])
    keys = jax.random.split(jax.random.key(0), 200)
    sampled = np.asarray(jax.vmap(env.sample_task)(keys).direction)
    assert set(sampled) == {1.0, -1.0}
    assert abs(sampled.mean()) < 0.25


def test_an_unknown_backend_is_refused() -> None:
    with pytest.raises(ValueError, match="backend='warp' is unknown; choose one of: auto, mujoco"):
        envs_jax.make("half_cheetah", backend="warp")


def test_a_renderer_that_mujoco_refuses_is_told_before_it_is_imported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "banana")
    with pytest.raises(ValueError, match=r"MUJOCO_GL=banana in the environment .*: unset it, or"):
        HalfCheetah()
    monkeypatch.setenv("MUJOCO_GL", "EGL ")  # as MuJoCo reads it
    assert HalfCheetah().observation_size == 20


def test_a_missing_package_names_the_extra() -> None:
    with pytest.raises(
        ImportError,
        match=r"no_such_package.part is not installed: pip install 'emrld-jax\[mujoco\]'",
    ):
        check_installed(("mujoco", "no_such_package.part"))


def test_mjx_on_a_cpu_says_that_it_is_slow() -> None:
    if jax.default_backend() != "cpu":
        pytest.skip("not on a CPU")
    env = HalfCheetah(backend="mjx", mjx_iterations=3)  # which no other test has made
    with pytest.warns(SlowBackendWarning, match="as slow as backend=mujoco"):
        assert isinstance(env.physics, Mjx)
    assert isinstance(HalfCheetah().physics, Engine)


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("body_mass", 1, 6.0),
        ("geom_condim", 3, 1),
        ("jnt_limited", 4, 0),
        ("qpos_spring", 5, 0.1),
        ("dof_frictionloss", 2, 0.1),
        ("actuator_gainprm", 0, 2.0),
        ("opt.disableflags", None, 16),  # no contacts
        ("opt.impratio", None, 2.0),
    ],
)
def test_a_model_that_has_changed_is_noticed(
    name: str, index: int | None, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        changed = load_model("half_cheetah")
    assert fingerprint(changed) == RECORDED["half_cheetah"]
    if index is None:
        setattr(changed.opt, name.removeprefix("opt."), value)
    else:
        getattr(changed, name)[index] = value
    monkeypatch.setitem(RECORDED, "half_cheetah", fingerprint(changed))
    with pytest.warns(ModelChangedWarning, match=f"differs in {name} from"):
        load_model("half_cheetah")


def test_looking_for_packages_imports_none() -> None:
    """What MuJoCo renders with is read when it is imported, so that must not be too early."""
    code = "import sys, envs_jax; envs_jax.make('half_cheetah', backend='mjx'); "
    code += "sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_both_backends_collect_the_same_episodes() -> None:
    """As long as they have not drifted apart; and each gives the same numbers for the same key."""
    policy = gaussian_policy(20, 6, hidden_sizes=(8,))
    params, found = policy.init(jax.random.key(0)), {}
    for backend in ("mujoco", "mjx"):
        env = HalfCheetah(reward="dense", horizon=6, backend=backend)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SlowBackendWarning)
            collect = jax.jit(collector(env, policy, 3, 0.95, 1.0))
            found[backend] = collect(params, jax.random.key(1), BACKWARD)
            again = collect(params, jax.random.key(1), BACKWARD)
        np.testing.assert_array_equal(found[backend].trajectory.obs, again.trajectory.obs)
    for name in ("obs", "action", "reward"):
        ours, theirs = (getattr(found[b].trajectory, name) for b in ("mjx", "mujoco"))
        np.testing.assert_allclose(ours, theirs, atol=2e-2)


def test_seeds_tasks_and_episodes_are_stepped_in_one_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """2 seeds, 2 tasks, 3 episodes: 12 simulations a call; 4 steps before adaptation and after."""
    sizes: list[int] = []
    advance_all = Engine._advance_all

    def spied(self: Engine, bodies: Any, controls: Any) -> np.ndarray:
        sizes.append(int(np.prod(np.shape(bodies)[:-1])))
        return advance_all(self, bodies, controls)

    monkeypatch.setattr(Engine, "_advance_all", spied)
    settings = Settings(
        policy=PolicySettings(hidden_sizes=[4]), adapt=AdaptSettings(num_episodes=3)
    )
    learner = algorithms.make("maml", HalfCheetah(horizon=4), settings)
    learners = side_by_side(lambda values: learner.halves, make_mesh(jax.devices()[:1], 2, 2))
    states = jax.vmap(learner.init)(jax.random.split(jax.random.key(0), 2))
    demos = Demos(jnp.zeros((2, 1, 20)), jnp.zeros((2, 1, 6)), jnp.ones((2, 1)))
    keys = jax.random.split(jax.random.key(1), 2)
    _, metrics = learners.update(states, keys, {}, HalfCheetah().test_tasks(), demos, None)
    np.testing.assert_array_equal(metrics["adapt/length_1"], 4.0)
    assert sizes == [12] * 8


def test_the_papers_cheetahs_move_as_ours(paper_demos: Path) -> None:
    """They were recorded with MuJoCo 2.0, whose contacts differ a little."""
    with np.load(paper_demos / "half_cheetah_optimal.npz") as recorded:
        states, actions = recorded["state"], np.clip(recorded["action"], -1, 1)
    before, after = states[:, :-1].reshape(-1, 20), states[:, 1:].reshape(-1, 20)
    bodies = jax.vmap(lambda obs: pack(HalfCheetah().positions(obs), obs[8:17]))(before)
    moved = jax.vmap(engine().advance)(
        bodies, jnp.asarray(actions[:, :-1].reshape(-1, 6), jnp.float32)
    ).body
    error = np.median(np.abs(np.asarray(moved)[:, 1:18] - after[:, :17]), axis=0)
    assert error[:8].max() < 0.005  # rad, m
    assert error[8:].max() < 0.12  # rad/s, m/s
