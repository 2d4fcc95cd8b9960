"""The environments for Gymnasium: `gymnasium.make("bridges.gymnasium:emrld/Point2D-v0")`.

Importing this package registers them, and needs no JAX; making one does, but for the robot.
"""

from __future__ import annotations

try:
    from gymnasium import register
except ModuleNotFoundError as error:
    raise ImportError("gymnasium is not installed: pip install -e '.[gymnasium]'") from error

ENVIRONMENTS = {  # Gymnasium's name of each of envs_jax.names()
    "Point2D": "point2d",
    "TwoWheeled": "two_wheeled",
    "TwoWheeledDrift": "two_wheeled_drift",
    "HalfCheetah": "half_cheetah",
}

for _title, _name in ENVIRONMENTS.items():
    # No max_episode_steps: the horizon is a parameter, and the environments truncate by it.
    register(
        f"emrld/{_title}-v0",
        entry_point="bridges.gymnasium.single:JaxEnv",
        vector_entry_point="bridges.gymnasium.vector:JaxVectorEnv",
        kwargs={"name": _name},
    )

register(
    "emrld/TurtleBot3-v0",
    entry_point="bridges.gymnasium.turtlebot:TurtleBot3Env",
    nondeterministic=True,
)
