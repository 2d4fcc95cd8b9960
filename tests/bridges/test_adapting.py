"""Adaptation from recordings is adaptation in simulation."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bridges.adapting import adapted, rollout
from bridges.bundle import Bundle, Stage, read, write
from bridges.driving import log_prob
from bridges.episodes import Episode, Step
from bridges.learning import learning
from bridges.messages import TWIST_STAMPED, BridgeError, Command
from bridges.parameters import params_of
from bridges.policy import Policy
from bridges.recording import Header, Recorder, Recording, header_of
from bridges.recording import read as read_recording
from bridges.stages import digest, is_after_step, steps
from emrld_jax.sampling.rollouts import collector
from emrld_jax.types import Params, Rollout, Task, Trajectory
from tests.bridges import robot_bundles

EPISODES = 4


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return robot_bundles.collecting("emrld")


def header(bundle: Bundle, **changes: Any) -> Header:
    given = {"noise": True, "dry_run": False, "command_type": TWIST_STAMPED, "driving": {}}
    return header_of(bundle, **{**given, **changes})


def as_driven(trajectory: Trajectory) -> list[Episode]:
    """Simulated episodes as if a robot had driven them. [E, T, ..]."""
    arrays = {name: np.asarray(x) for name, x in trajectory._asdict().items()}
    episodes = []
    for e, mask in enumerate(arrays["mask"]):
        number = int(mask.sum())
        rows = [{name: x[e, t] for name, x in arrays.items()} for t in range(number)]
        steps = [
            Step(
                time=7.0 + 0.5 * t,
                obs=row["obs"],
                action=row["action"],
                command=Command(0.1, 0.0),
                log_prob=float(row["log_prob"]),
                reward=float(row["reward"]),
                done=bool(row["done"]),
                success=bool(row["success"]),
                age=0.01,
                latency=0.0,
            )
            for t, row in enumerate(rows)
        ]
        last = steps[-1]
        ending = "success" if last.success else "arena" if last.done else "horizon"
        pose = arrays["obs"][e, min(number, len(mask) - 1)]
        episodes.append(Episode(7.0, 10**18, steps, pose, ending, "", 0, (), ()))
    return episodes


def simulated(bundle: Bundle) -> tuple[Params, list[Trajectory]]:
    """Adaptation in simulation: the parameters, and each inner step's episodes."""
    parts, trajectories = learning(bundle), []
    adapt = parts.settings.adapt
    collect = collector(parts.env, parts.learner.policy, EPISODES, adapt.discount, adapt.gae_lambda)

    def watched(params: Params, key: jax.Array, task: Task) -> Rollout:
        rollout = collect(params, key, task)
        trajectories.append(rollout.trajectory)
        return rollout

    key = jax.random.key(8)
    done = parts.learner.adapt(parts.params, key, parts.task, parts.demos, watched)
    return done.params, trajectories


def recorded(folder: Path, bundle: Bundle, trajectory: Trajectory) -> Recording:
    recorder = Recorder(folder, header(bundle))
    for episode in as_driven(trajectory):
        recorder.add(episode)
    return read_recording(folder)


@pytest.mark.parametrize(("algorithm", "number"), [("emrld_ws", 1), ("emrld", 2)])
def test_recorded_episodes_adapt_as_in_simulation(
    tmp_path: Path, algorithm: str, number: int
) -> None:
    bundle = robot_bundles.collecting(algorithm, num_steps=number, learning_rate=0.1)
    expected, trajectories = simulated(bundle)
    assert len(trajectories) == number
    policy, (first, *_) = Policy(bundle), trajectories
    own = [log_prob(policy, o, a) for o, a in zip(first.obs[0], first.action[0], strict=True)]
    assert np.allclose(own, first.log_prob[0], atol=1e-4)

    start, recordings = bundle, list[Recording]()
    for k, trajectory in enumerate(trajectories):
        assert not bundle.stage.adapted
        recordings.append(recorded(tmp_path / f"recording_{k}", bundle, trajectory))
        before_step, bundle = bundle, adapted(bundle, recordings)
        assert is_after_step(bundle, before_step, recordings[-1])
        assert not is_after_step(bundle, bundle, recordings[-1])
        assert not is_after_step(bundle, before_step, recordings[-1]._replace(episodes=()))
        write(tmp_path / "b.safetensors", bundle)
        bundle = read(tmp_path / "b.safetensors")

    assert bundle.stage == (number, True)
    found = params_of(bundle, "policy")
    before = params_of(bundle, "meta")
    moved = jax.tree.map(lambda a, b: float(np.max(np.abs(a - b))), found, before)
    assert max(jax.tree.leaves(moved)) > 1e-2
    for own_values, simulation in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(own_values, simulation, rtol=1e-4, atol=2e-6)
    assert {name for name in start.tensors if not same(start, bundle, name)} == {
        f"policy/layer_{k}/{name}" for k in range(3) for name in ("kernel", "bias")
    }
    changed = ("stage", "provenance", "tensors")
    others = [item.name for item in fields(bundle) if item.name not in changed]
    assert all(getattr(start, name) == getattr(bundle, name) for name in others)
    assert [row["episodes"] for row in steps(bundle)] == [EPISODES] * number
    assert [row["recording"] for row in steps(bundle)] == [digest(r) for r in recordings]


def same(bundle: Bundle, other: Bundle, name: str) -> bool:
    return np.array_equal(bundle.tensors[name], other.tensors[name])


def one_recording(bundle: Bundle, **changes: Any) -> Recording:
    """Two episodes of the bundle's own actions, one of which was broken off."""
    policy = Policy(bundle)
    generator = np.random.default_rng(0)
    steps = []
    for t in range(30):
        obs = np.array([0.02 * t, 0.01 * t, 0.1], np.float32)
        action = policy.sample(obs, generator).astype(np.float32)
        density = log_prob(policy, obs, action)
        reward = 0.6 if t > 25 else 0.0
        steps.append(
            Step(t / 2, obs, action, Command(0, 0), density, reward, False, False, 0.01, 0.0)
        )
    whole = Episode(0.0, 0, steps, np.zeros(3, np.float32), "horizon", "", 0, (), ())
    broken = whole._replace(steps=steps[:15], ending="stale")
    return Recording(header(bundle, **changes), (whole, broken))


def test_what_was_broken_off_is_not_learned_from(bundle: Bundle) -> None:
    recording = one_recording(bundle)

    taken = rollout(learning(bundle), recording)

    assert taken.trajectory.mask.shape == (1, 30)
    assert np.all(taken.trajectory.mask == 1)
    assert np.array_equal(
        taken.trajectory.action[0], [step.action for step in recording.episodes[0].steps]
    )
    assert digest(recording) == digest(recording._replace(episodes=recording.episodes[:1]))


def test_steps_after_an_end_are_masked(bundle: Bundle) -> None:
    recording = one_recording(bundle)
    whole = recording.episodes[0]
    last = whole.steps[9]._replace(done=True, success=True, reward=20.0)
    short = whole._replace(steps=(*whole.steps[:9], last), ending="success")

    taken = rollout(learning(bundle), recording._replace(episodes=(whole, short)))

    mask = np.asarray(taken.trajectory.mask)
    assert mask.sum(axis=1).tolist() == [30, 10]
    assert np.all(np.asarray(taken.advantage)[mask == 0] == 0)
    assert taken.trajectory.done[1].tolist() == [0] * 9 + [1] + [0] * 20
    assert float(jnp.sum(taken.trajectory.success)) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: [], "0 recordings are given; the bundle needs 1"),
        (lambda r: [r, r], "2 recordings are given"),
        (lambda r: [r._replace(header=replace(r.header, bundle="0" * 64))], "by another bundle"),
        (lambda r: [r._replace(header=replace(r.header, dry_run=True))], "of a dry run"),
        (lambda r: [r._replace(header=replace(r.header, noise=False))], "without the policy's"),
        (lambda r: [r._replace(header=replace(r.header, control_period=0.1))], "control period"),
        (lambda r: [r._replace(header=replace(r.header, horizon=99))], "period or horizon"),
        (lambda r: [r._replace(episodes=())], "has no whole episode"),
        (lambda r: [r._replace(episodes=r.episodes[1:])], "has no whole episode"),
        (
            lambda r: [r._replace(episodes=(turned(r.episodes[0]),))],
            "was not sampled by the bundle",
        ),
    ],
)
def test_other_recordings_are_refused(bundle: Bundle, change: Any, words: str) -> None:
    with pytest.raises(BridgeError, match=words):
        adapted(bundle, change(one_recording(bundle)))


def turned(episode: Episode) -> Episode:
    step = episode.steps[3]
    changed = step._replace(action=step.action + np.float32(0.1))
    return episode._replace(steps=(*episode.steps[:3], changed, *episode.steps[4:]))


def test_an_adapted_bundle_is_refused(bundle: Bundle) -> None:
    with pytest.raises(BridgeError, match="adapted already"):
        adapted(replace(bundle, stage=Stage(1, True)), [one_recording(bundle)])
