"""What a run's demonstrations return in its own environment, to stand beside its returns."""

from __future__ import annotations

from typing import Any

import numpy as np

from emrld_jax.demos import DemoSet, replay
from envs_jax import Env, make

DECISIVE = ("reward", "horizon", "reward_radius", "zone_distance")  # of what episodes return


def demonstrated(env: Env, demos: DemoSet) -> dict[str, Any]:
    """The demonstrations' mean return and success, and the kind of reward, as JSON values.

    What their file says, which is what they return in the environment as it is by default: with
    sparse reward. Where the environment is another one, what their actions return in it when they
    are played back, open loop.

    Args:
        env: the run's.
        demos: at least one.
    """
    found = demos.returns, demos.success
    if _pays_otherwise(env):
        found = replay(env, demos.tasks, demos.demos)
    returns, success = (float(np.mean(np.asarray(column, float))) for column in found)
    return {"return": returns, "success": success, "reward": env.reward}


def _pays_otherwise(env: Env) -> bool:
    """Whether episodes may return something else than by default."""
    default = make(env.name)
    return any(getattr(env, name, None) != getattr(default, name, None) for name in DECISIVE)
