"""What demonstrations of a quality claim to be, environment by environment."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from emrld_jax.demos.archive import DemoError
from emrld_jax.types import Demos, Task
from envs_jax import Env


class Played(NamedTuple):
    """Episodes of an expert."""

    demos: Demos  # [.., T, ..], actions as the environment bounds them
    reward: jax.Array  # [.., T], dense
    success: jax.Array  # [..], 1 if the episode reached the goal
    tasks: Task  # [..]


class Claim(NamedTuple):
    """What one episode must be."""

    words: str  # "reach its goal"
    holds: Callable[[Played], jax.Array]  # (one episode) -> [], bool
    tell: Callable[[Played], str]  # (one episode) -> "ends .."
    cut: Callable[[Played], Played] = lambda episode: episode  # the part that is taken


class Near(NamedTuple):
    """A sub-optimal demonstration of an environment with goals."""

    max_steps: int  # about 1.5 times the straight way at full speed; a longer one wanders
    nearest: float  # m: how near to the goal it may end
    farthest: float  # m: how far from the goal it may end
    may_reach: bool  # whether it may succeed; else it stops once it is near


# Point2D's demonstrations come near and reach nothing; the wheeled ones end in the reward zone.
NEAR = {
    "point2d": Near(30, 0.1, 0.4, may_reach=False),
    "two_wheeled": Near(31, 0.0, 0.5, may_reach=True),
    "two_wheeled_drift": Near(45, 0.0, 0.5, may_reach=True),
}

# HalfCheetah: the dense returns of the paper's demonstrations; and pieces that show how to run, but
# end before anything is rewarded
FORWARD_RETURN, BACKWARD_RETURN = 279.0, 475.0
PIECE_STEPS, PIECE_LEAST, PIECE_MOST = 20, 1.0, 1.9  # steps, m, m


def claim(env: Env, quality: str) -> Claim:
    """What demonstrations of this quality claim to be in an environment.

    Raises:
        DemoError: nobody has said so yet.
    """
    if env.name == "half_cheetah":
        return {"optimal": _fast(), "suboptimal": _piece(env)}[quality]
    if quality == "optimal":
        return Claim("reach its goal", lambda played: played.success > 0, _where_it_ends)
    if env.name not in NEAR:
        raise DemoError(
            f"what suboptimal means is not defined for {env.name}, only for "
            f"{', '.join(NEAR)} and half_cheetah; say so in emrld_jax/demos/claims.py"
        )
    rule = NEAR[env.name]
    words = f"end {rule.nearest} to {rule.farthest} m from its goal after at most "
    words += f"{rule.max_steps} steps" + ("" if rule.may_reach else " and not reach it")
    return Claim(words, partial(_is_near, rule), _where_it_ends, partial(_cut_near, rule))


def distances(played: Played) -> jax.Array:
    """How far from the goal each step of an episode ended, [T] in m: what dense reward says."""
    return -played.reward


def end_distance(played: Played) -> jax.Array:
    """How far from the goal an episode ended, [] in m."""
    last = jnp.sum(played.demos.mask).astype(jnp.int32) - 1
    return distances(played)[last]


def _is_near(rule: Near, played: Played) -> jax.Array:
    distance = end_distance(played)
    short = jnp.sum(played.demos.mask) <= rule.max_steps
    near = (distance >= rule.nearest) & (distance <= rule.farthest)
    return short & near & (rule.may_reach | (played.success == 0))


def _cut_near(rule: Near, noisy: Played) -> Played:
    """An episode up to where it came nearest to the goal, or near if it may not reach it."""
    distance = jnp.where(noisy.demos.mask > 0, distances(noisy), jnp.inf)
    last = jnp.argmin(distance)
    if not rule.may_reach:
        near = distance <= 0.5 * (rule.nearest + rule.farthest)
        last = jnp.where(jnp.any(near), jnp.argmax(near), last)
    return _first_steps(noisy, last + 1)


def _first_steps(played: Played, steps: jax.Array | int) -> Played:
    """The beginning of an episode; it has succeeded only if it is all of it."""
    whole = played.demos.mask
    mask = whole * (jnp.arange(whole.shape[0]) < steps)
    success = played.success * (jnp.sum(mask) == jnp.sum(whole))
    return played._replace(demos=played.demos._replace(mask=mask), success=success)


def _where_it_ends(played: Played) -> str:
    return (
        f"ends after {int(jnp.sum(played.demos.mask))} steps {float(end_distance(played)):.3f} m "
        f"away (reached: {bool(played.success > 0)})"
    )


def dense_return(played: Played) -> jax.Array:
    """The sum of an episode's dense rewards, []."""
    return jnp.sum(played.reward * played.demos.mask)


def _fast() -> Claim:
    """A cheetah that runs as fast as the paper's demonstrator."""

    def least(played: Played) -> jax.Array:
        return jnp.where(played.tasks.direction > 0, FORWARD_RETURN, BACKWARD_RETURN)

    words = f"have a dense return of {FORWARD_RETURN:g} forward, {BACKWARD_RETURN:g} backward"
    return Claim(
        words,
        lambda played: dense_return(played) >= least(played),
        lambda played: f"has {float(dense_return(played)):.1f}",
    )


def _piece(env: Env) -> Claim:
    """The first steps of a cheetah that runs in the right direction, but not out of the dark."""

    def run(played: Played) -> jax.Array:
        """How far it has run after each step, [T] in m: dense reward without the torques' cost."""
        cost = env.control_cost * jnp.sum(played.demos.action**2, axis=-1)  # type: ignore[attr-defined]
        return env.dt * jnp.cumsum(played.reward + cost)

    def holds(played: Played) -> jax.Array:
        exists, way = played.demos.mask > 0, run(played)
        inside = jnp.all(jnp.abs(way) * exists <= PIECE_MOST)
        return inside & (way[PIECE_STEPS - 1] >= PIECE_LEAST) & (jnp.sum(exists) == PIECE_STEPS)

    def tell(played: Played) -> str:
        steps = int(jnp.sum(played.demos.mask))
        return f"has run {float(run(played)[steps - 1]):.2f} m after {steps} steps"

    words = f"run {PIECE_LEAST:g} to {PIECE_MOST:g} m in {PIECE_STEPS} steps"
    return Claim(words, holds, tell, lambda played: _first_steps(played, PIECE_STEPS))
