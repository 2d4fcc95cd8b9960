"""One environment of `envs_jax` as Gymnasium has them."""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.error import ResetNeeded

import envs_jax
from bridges.gymnasium.checks import METADATA, check_options, checked_action
from bridges.gymnasium.painters import metadata, painter
from bridges.gymnasium.programs import information, programs
from bridges.gymnasium.spaces import action_space, observation_space
from bridges.gymnasium.tasks import TaskChoice

OPTIONS = ("task", "split")


class JaxEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment whose actions and observations are in physical units.

    Actions beyond the space are bounded as the environment bounds them: each number by itself, or
    for Point2D, whose moves are at most 0.1 m long, by shortening the move. So a corner of its
    action space, a square, does the same as the point of the circle in its direction.

    An episode is `terminated` by success, by leaving the arena, or where a simulation broke down;
    it is `truncated` where the horizon comes before.

    Args:
        name: one of `envs_jax.names()`.
        task: of every episode: its number in the split, or what it is, such as `{"goal": [2, 0]}`;
            None: a random one of the split for each episode.
        split: whose tasks are meant, "train" or "test".
        render_mode: "rgb_array" or None.
        **parameters: of the environment, such as `reward="dense"` or `horizon=50`.

    Attributes:
        family: the environment of `envs_jax`.

    Raises:
        ValueError: an unknown parameter or task, or an impossible value.
        MissingPackageError: a package of the environment's is not installed.
        ConfigError: nothing can render here.
    """

    metadata = METADATA

    def __init__(
        self,
        name: str,
        *,
        task: Any = None,
        split: str = "train",
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        self.family = envs_jax.make(name, **parameters)
        self._painter = painter(self.family, render_mode)
        self.render_mode, self.metadata = render_mode, metadata(self.family)
        self.action_space = action_space(self.family)
        self.observation_space = observation_space(self.family)
        self._choice = TaskChoice(self.family, split, task)
        self._programs = programs(self.family, batched=False)
        self._path: list[np.ndarray] = []  # what was observed in this episode
        self._going = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: of all episodes from now on; None: they go on from the one before.
            options: `task` and `split`, as the environment takes them, for this episode.

        Returns:
            The observation, and info: the task's numbers, and figures as after a step.

        Raises:
            ValueError: an unknown option or task.
        """
        super().reset(seed=seed)
        start = self._choice.draw(self.np_random, check_options(options, OPTIONS))
        self._task = start.task
        self._state = self._programs.reset(start.seed, start.task)
        self._going, self._t, self._path = True, 0, []
        obs, _, _, info = self._told()
        return obs, info

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Acts with a physical action.

        Returns:
            Observation, reward, terminated, truncated, and info: `task`, the task's numbers;
            `success`, whether this step was one; `diverged`, whether the simulation broke down.

        Raises:
            ResetNeeded: no episode has begun, or it has ended.
            ValueError: the action has another shape, or is not finite.
        """
        if not self._going:
            raise ResetNeeded("there is no episode, or it has ended: reset() begins one")
        checked = checked_action(action, (self.family.action_size,))
        self._state = self._programs.step(self._state, checked)
        self._t += 1
        obs, reward, terminated, info = self._told()
        truncated = not terminated and self._t >= self.family.horizon
        self._going = not (terminated or truncated)
        return obs, reward, terminated, truncated, info

    def render(self) -> Any:
        """A picture of what has happened in this episode, [height, width, 3] uint8.

        Raises:
            ResetNeeded: no episode has begun.
        """
        if self._painter is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array' when it is made")
            return None
        if not self._path:
            raise ResetNeeded("there is nothing to render before reset()")
        return self._painter.paint(np.stack(self._path), self._task)

    def close(self) -> None:
        """Frees what renders."""
        if self._painter is not None:
            self._painter.close()

    def _told(self) -> tuple[np.ndarray, float, bool, dict[str, Any]]:
        """Observation, reward, whether the environment has ended the episode, and info."""
        state = self._state
        obs, reward, done, metrics = jax.device_get(
            (state.obs, state.reward, state.done, state.metrics)
        )
        if self._painter is not None:
            self._path.append(obs)
        return np.array(obs), float(reward), bool(done), information(self._task, metrics)
