"""How near MJX, MuJoCo in C and Gymnasium are to each other on HalfCheetah.

`python -m benchmarks.fidelity` trains an expert for a while, visits states with random actions,
with the expert and after falls, and compares: one step from each of these states, 100 steps of the
same actions, the return of the same expert. `recorded=FILE.npz` also compares one step of MuJoCo in
C with steps that others recorded (arrays `state` [K, T, 20], `action` [K, T, 6], `length` [K]).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.choice import origin
from benchmarks.records import write_record
from benchmarks.timing import seconds
from benchmarks.visits import Visited, trained_expert, visited_by
from emrld_jax.demos.expert import conditioned
from emrld_jax.fields import setting
from emrld_jax.policy import Policy, mean_action
from emrld_jax.runs import cli
from emrld_jax.runs.config import check_config
from emrld_jax.sampling.rollouts import episode, episode_returns
from envs_jax.half_cheetah import HalfCheetah
from envs_jax.physics.models import silent_mujoco

# iterations of MJX's contact solver, and of each one's line search; the last are the model's own
SETTINGS = ((1, 4), (2, 4), (4, 4), (100, 50))
NQ, NV = 9, 9


@dataclass
class FidelityConfig:
    """All settings of the comparison."""

    iterations: int = setting(60, "of the expert's training", at_least=1)
    episodes: int = setting(20, "of each kind that states are taken from", at_least=2)
    recorded: str | None = setting(None, "recorded steps to compare with, a .npz file")


Advance = Callable[[Any, Any], Any]  # bodies [K, 27], actions [K, 6] -> bodies [K, 27]


def advance_of(env: HalfCheetah) -> Advance:
    """One environment step of the environment's physics, compiled, batched."""
    return jax.jit(jax.vmap(lambda body, action: env.physics.advance(body, action).body))


class Gymnasium:
    """HalfCheetah-v5, which is set to a state before each step or goes on from where it is."""

    def __init__(self) -> None:
        import gymnasium  # noqa: PLC0415

        with silent_mujoco():
            self._env: Any = gymnasium.make("HalfCheetah-v5").unwrapped
            self._env.reset(seed=0)

    def run(self, body: Any, actions: Any) -> np.ndarray:
        """Bodies after each of the actions [T, 6], from one [27]: positions and velocities."""
        self._env.set_state(np.float64(body[:NQ]), np.float64(body[NQ : NQ + NV]))
        data, after = self._env.data, []
        for action in actions:
            self._env.step(np.float64(action))
            after.append(np.concatenate([data.qpos, data.qvel]))
        return np.stack(after)


def one_step_errors(after: Any, reference: Any) -> list[float]:
    """Median and 99th percentile, over steps, of the largest error of a position and a velocity."""
    error = np.abs(np.asarray(after)[:, : NQ + NV] - reference)
    positions, velocities = error[:, :NQ].max(axis=1), error[:, NQ:].max(axis=1)
    return [float(np.percentile(e, p)) for e in (positions, velocities) for p in (50, 99)]


def drift(advance: Advance, starts: Any, actions: Any, reference: Any) -> list[float]:
    """Median over episodes of how far x, in m, and the worst angle, in rad, are off at the end."""
    bodies = jnp.asarray(starts)
    for t in range(actions.shape[1]):
        bodies = advance(bodies, actions[:, t])
    error = np.abs(np.asarray(bodies)[:, :NQ] - reference[:, -1, :NQ])
    return [float(np.median(error[:, 0])), float(np.median(error[:, 2:].max(axis=1)))]


def returns(env: HalfCheetah, policy: Policy, params: Any, episodes: int) -> list[float]:
    """Dense return of the mean action, forward and backward, each with its standard error."""

    def of_task(task: Any) -> Any:
        own = conditioned(mean_action(policy), task)
        keys = jax.random.split(jax.random.key(2), episodes)
        return jax.vmap(lambda key: episode_returns(episode(env, own, params, key, task)))(keys)

    found = np.asarray(jax.jit(jax.vmap(of_task))(env.test_tasks()))
    deviation = found.std(axis=1, ddof=1) / np.sqrt(episodes)
    return [float(x) for x in (found[0].mean(), deviation[0], found[1].mean(), deviation[1])]


def recorded_errors(path: str, advance: Advance) -> list[float]:
    """Medians over recorded steps of the largest error of a joint's position and velocity."""
    with np.load(path, allow_pickle=False) as arrays:
        states, actions, lengths = (arrays[key] for key in ("state", "action", "length"))
    errors = []
    for state, action, length in zip(states, actions, lengths, strict=True):
        bodies = np.stack([body_of(obs) for obs in state[: length - 1]])
        after = np.asarray(advance(bodies, np.clip(action[: length - 1], -1, 1)))
        errors.append(np.abs(after[:, 1:18] - state[1:length, :17]))
    median = np.median(np.concatenate(errors), axis=0)
    return [float(median[:8].max()), float(median[8:].max())]


def body_of(obs: Any) -> Any:
    """The body that was observed, its solver starting from nothing. [20] -> [27]."""
    env = HalfCheetah()
    task = jax.tree.map(lambda x: x[0], env.test_tasks())
    return env.reset_to(jnp.asarray(obs), task).pipeline_state.body


def simulators() -> dict[str, HalfCheetah]:
    """What is compared with Gymnasium."""
    found = {"MuJoCo in C": HalfCheetah(reward="dense", backend="mujoco")}
    for solver, search in SETTINGS:
        found[f"MJX, {solver} and {search} iterations"] = HalfCheetah(
            reward="dense", backend="mjx", mjx_iterations=solver, mjx_line_search=search
        )
    return found


def compare(
    env: HalfCheetah,
    visited: dict[str, Visited],
    steps: dict[str, np.ndarray],
    paths: dict[str, np.ndarray],
) -> dict[str, Any]:
    """One simulator's speed and errors; `steps` and `paths` are where Gymnasium came to."""
    advance = advance_of(env)
    pairs = {kind: (_flat(v.body), _flat(v.action)) for kind, v in visited.items()}
    many = next(iter(pairs.values()))
    times = seconds(partial(advance, *many), 3)
    return {
        "steps_per_s": float(len(many[0]) / np.median(times)),
        "one_step": {
            kind: one_step_errors(advance(*pair), steps[kind]) for kind, pair in pairs.items()
        },
        "drift": {
            kind: drift(advance, v.body[:, 0], v.action, paths[kind]) for kind, v in visited.items()
        },
    }


def main() -> int:
    """Compares and writes the table."""
    config = cli.updated(FidelityConfig(), cli.parse(sys.argv[1:], FidelityConfig(), {}))
    check_config(config)
    learner, state = trained_expert(config.iterations)
    visited = visited_by(HalfCheetah(reward="dense"), learner, state, config.episodes)
    gym, steps, paths = Gymnasium(), {}, {}
    for kind, v in visited.items():
        pairs = zip(_flat(v.body), _flat(v.action), strict=True)
        steps[kind] = np.stack([gym.run(body, [action])[0] for body, action in pairs])
        episodes = zip(v.body, v.action, strict=True)
        paths[kind] = np.stack([gym.run(bodies[0], actions) for bodies, actions in episodes])
    rows = []
    for name, env in simulators().items():
        row = {"simulator": name, **compare(env, visited, steps, paths)}
        row["returns"] = returns(env, learner.policy, state.policy, config.episodes)
        print(f"{name}: {row['steps_per_s']:,.0f} environment steps/s", flush=True)
        rows.append(row)
    record, text = {**origin("fidelity"), "rows": rows}, _tables(rows)
    if config.recorded:
        record["recorded"] = recorded_errors(
            config.recorded, advance_of(simulators()["MuJoCo in C"])
        )
        text += (
            "\n\nRecorded steps against MuJoCo in C, median over steps of the worst joint: "
            "{:.2g} rad or m, {:.2g} rad/s or m/s.".format(*record["recorded"])
        )
    write_record("fidelity-half_cheetah", record, text)
    return 0


def _flat(x: np.ndarray) -> np.ndarray:
    """Episodes' steps in a row. [E, T, ..] -> [E T, ..]."""
    return x.reshape(-1, x.shape[-1])


def _tables(rows: list[dict[str, Any]]) -> str:
    """One step, then all else, as Markdown."""
    kinds = list(rows[0]["one_step"])
    lines = [
        "One step against Gymnasium: largest error of a position (rad or m), of a velocity (rad/s "
        "or m/s), median / 99th percentile over steps.",
        "",
        "| | " + " | ".join(f"{kind}: positions | velocities" for kind in kinds) + " |",
        "|---" * (1 + 2 * len(kinds)) + "|",
    ]
    for row in rows:
        cells = []
        for kind in kinds:
            p50, p99, v50, v99 = row["one_step"][kind]
            cells += [f"{p50:.1g} / {p99:.1g}", f"{v50:.1g} / {v99:.1g}"]
        lines.append(f"| {row['simulator']} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "Off Gymnasium after 100 steps of the same actions (median over episodes: x in m, worst "
        "angle in rad), dense return of the expert's mean action (± standard error), speed.",
        "",
        "| | " + " | ".join(kinds) + " | return forward | return backward | environment steps/s |",
        "|---" * (4 + len(kinds)) + "|",
    ]
    for row in rows:
        cells = [f"{x:.2g} m, {angle:.2g}" for x, angle in row["drift"].values()]
        forward, f_error, backward, b_error = row["returns"]
        cells += [f"{forward:.1f} ± {f_error:.1f}", f"{backward:.1f} ± {b_error:.1f}"]
        lines.append(
            f"| {row['simulator']} | " + " | ".join(cells) + f" | {row['steps_per_s']:,.0f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    cli.run_command(main)
