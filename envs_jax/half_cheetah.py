"""HalfCheetah forward-backward: run in the direction that the task says (section B.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from envs_jax.base import State, check_parameters
from envs_jax.physics import Choice, Physics, check_backend, make_physics, pack

JOINTS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
NUM_TASKS = 10


class CheetahTask(NamedTuple):
    """A task named by where to run."""

    direction: jax.Array  # [], +1 forward, -1 backward; a batch of tasks has [M]


class Cheetah(NamedTuple):
    body: jax.Array  # [27], see envs_jax.physics
    start_x: jax.Array  # [], m, where the torso was at the reset
    t: jax.Array  # [], steps taken


@dataclass(frozen=True)
class HalfCheetah:
    """A two-legged cheetah in a plane, which is rewarded where it has left its start behind.

    Nothing but the horizon ends an episode. A step is a success where the cheetah has left its
    start `zone_distance` behind in the direction that it should run.

    Attributes:
        reward: "sparse" (nothing within `zone_distance` of the start) or "dense" (everywhere).
        horizon: steps an episode.
        zone_distance: m; farther from its start, on either side, a step is rewarded.
        backend: "mujoco" (MuJoCo in C), "mjx", or "auto": C on a CPU, MJX on an accelerator.
        mjx_iterations: of MJX's contact solver.
        mjx_line_search: iterations of its line search.

    Raises:
        ValueError: impossible parameters.
        MissingPackageError: a package of the backend's is not installed.
    """

    reward: str = "sparse"
    horizon: int = 100
    zone_distance: float = 2.0
    backend: str = "auto"
    mjx_iterations: int = 4
    mjx_line_search: int = 4

    name: ClassVar[str] = "half_cheetah"
    model: ClassVar[str] = "half_cheetah"
    frame_skip: ClassVar[int] = 5
    dt: ClassVar[float] = 0.05  # s
    observation_names: ClassVar[tuple[str, ...]] = (
        *("z", "pitch", *JOINTS),
        *("x_velocity", "z_velocity", "pitch_velocity", *(f"{j}_velocity" for j in JOINTS)),
        *("torso_x", "torso_y", "torso_z"),
    )
    observation_units: ClassVar[tuple[str, ...]] = (
        *("m", *["rad"] * 7),
        *("m/s", "m/s", *["rad/s"] * 7),
        *("m", "m", "m"),
    )
    action_names: ClassVar[tuple[str, ...]] = JOINTS
    action_units: ClassVar[tuple[str, ...]] = ("1",) * 6  # of each motor's full torque
    action_low: ClassVar[tuple[float, ...]] = (-1.0,) * 6
    action_high: ClassVar[tuple[float, ...]] = (1.0,) * 6
    control_cost: ClassVar[float] = 0.05

    def __post_init__(self) -> None:
        check_parameters(self.reward, self.horizon, zone_distance=self.zone_distance)
        check_backend(self.backend)
        for name in ("mjx_iterations", "mjx_line_search"):
            if (value := getattr(self, name)) < 1:
                raise ValueError(f"{name}={value} must be at least 1")

    @property
    def observation_size(self) -> int:
        return 20

    @property
    def action_size(self) -> int:
        return 6

    @property
    def physics(self) -> Physics:
        """What moves the body."""
        return make_physics(
            Choice(
                self.model,
                self.frame_skip,
                self.backend,
                self.mjx_iterations,
                self.mjx_line_search,
            )
        )

    def train_tasks(self) -> CheetahTask:
        """10 slots, forward and backward in turn; direction [10]."""
        return CheetahTask(1.0 - 2.0 * (jnp.arange(NUM_TASKS) % 2).astype(jnp.float32))

    def test_tasks(self) -> CheetahTask:
        """Forward and backward; direction [2]."""
        return CheetahTask(jnp.array([1.0, -1.0]))

    def sample_task(self, key: jax.Array) -> CheetahTask:
        """Forward or backward, equally likely."""
        return CheetahTask(2.0 * jax.random.bernoulli(key).astype(jnp.float32) - 1.0)

    def to_physical(self, action: jax.Array) -> jax.Array:
        """Policy action [6] -> torques [6], as parts of each motor's, within [-1, 1]."""
        return jnp.clip(action, -1.0, 1.0)

    def to_policy(self, physical_action: jax.Array) -> jax.Array:
        """Torques [6] -> policy action [6]: the same numbers."""
        return physical_action

    def reset(self, key: jax.Array, task: CheetahTask | None = None) -> State:
        """Near the model's rest, at random; without a task, a random one."""
        task_key, position_key, velocity_key = jax.random.split(key, 3)
        task = self.sample_task(task_key) if task is None else task
        qpos = jax.random.uniform(position_key, (9,), minval=-0.1, maxval=0.1)
        qvel = 0.1 * jax.random.normal(velocity_key, (9,))
        return self._begin(pack(qpos, qvel), task)

    def reset_to(self, obs: jax.Array, task: CheetahTask) -> State:
        """The start of an episode that begins where `obs` [20] was observed."""
        return self._begin(pack(self.positions(obs), obs[8:17]), task)

    def positions(self, obs: jax.Array) -> jax.Array:
        """The joints' positions that were observed. [.., 20] -> [.., 9]."""
        return jnp.concatenate([obs[..., 17:18], obs[..., :8]], axis=-1)

    def _begin(self, body: jax.Array, task: CheetahTask) -> State:
        zero = jnp.zeros(())
        cheetah = Cheetah(body, body[0], jnp.zeros((), jnp.int32))
        metrics = {"success": zero, "diverged": zero}
        return State(cheetah, _observe(body), zero, zero, metrics, {}, task)

    def step(self, state: State, action: jax.Array) -> State:
        """Moves for `dt` seconds with the policy action [6]."""
        cheetah: Cheetah = state.pipeline_state
        torques = self.to_physical(action)
        body, diverged = self.physics.advance(cheetah.body, torques)
        velocity = (body[0] - cheetah.body[0]) / self.dt
        way = body[0] - cheetah.start_x
        reward = state.task.direction * velocity - self.control_cost * jnp.sum(torques**2)
        if self.reward == "sparse":
            reward = jnp.where(jnp.abs(way) > self.zone_distance, reward, 0.0)
        success = (state.task.direction * way > self.zone_distance).astype(way.dtype)
        metrics = {"success": success, "diverged": diverged}
        return replace(
            state,
            pipeline_state=Cheetah(body, cheetah.start_x, cheetah.t + 1),
            obs=_observe(body),
            reward=jnp.where(diverged > 0, 0.0, reward),
            done=diverged,
            metrics={**state.metrics, **metrics},
        )


def _observe(body: jax.Array) -> jax.Array:
    """Positions but for x, velocities, and the torso's center; [27] -> [20]."""
    center = jnp.stack([body[0], jnp.zeros(()), 0.7 + body[1]])
    return jnp.concatenate([body[1:18], center])
