"""Many environments of `envs_jax` as one of Gymnasium's vector environments, stepped at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

import envs_jax
from bridges.gymnasium.checks import METADATA, check_options, checked_action
from bridges.gymnasium.painters import Painter, metadata, painter
from bridges.gymnasium.programs import information, last_words, masked, programs, replaced
from bridges.gymnasium.spaces import action_space, observation_space
from bridges.gymnasium.tasks import TaskChoice, blank, take

OPTIONS = ("task", "split", "reset_mask")


class JaxVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """n environments like `bridges.gymnasium.single.JaxEnv`, in one compiled program.

    Each has randomness of its own, so they do what n single ones with the seeds s, s + 1, .. do,
    to the last bit but for rounding.

    Args:
        name: one of `envs_jax.names()`.
        num_envs: n.
        task: of every episode, as a single environment takes it; or a list with one for each
            environment; None: random ones of the split.
        split: whose tasks are meant, "train" or "test".
        render_mode: "rgb_array" or None.
        autoreset_mode: what happens to an environment whose episode has ended: its next step is a
            reset (`NEXT_STEP`), it is reset at once and what ended is in info as `final_obs` and
            `final_info` (`SAME_STEP`), or nothing: `reset(options={"reset_mask": ..})` is for
            whoever steps (`DISABLED`).
        **parameters: of the environment, such as `reward="dense"` or `horizon=50`.

    Attributes:
        family: the environment of `envs_jax`.

    Raises:
        ValueError: an unknown parameter or task, or an impossible value.
        MissingPackageError: a package of the environment's is not installed.
        ConfigError: nothing can render here.
    """

    metadata = METADATA
    _painter: Painter | None = None  # until there is one: what was never made is closed, too

    def __init__(
        self,
        name: str,
        num_envs: int = 1,
        *,
        task: Any = None,
        split: str = "train",
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **parameters: Any,
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1")
        self.family, self.num_envs = envs_jax.make(name, **parameters), num_envs
        self._painter = painter(self.family, render_mode)
        self._mode = AutoresetMode(autoreset_mode)
        self.render_mode = render_mode
        self.metadata = {**metadata(self.family), "autoreset_mode": self._mode}
        self.single_action_space = action_space(self.family)
        self.single_observation_space = observation_space(self.family)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._choices = [TaskChoice(self.family, split, one) for one in self._each(task)]
        self._random = [seeding.np_random() for _ in range(num_envs)]  # generators and seeds
        self._programs = programs(self.family, batched=True)
        self._tasks = blank(self.family, num_envs)
        self._states: Any = None
        self._t = np.zeros(num_envs, int)
        self._ended = np.zeros(num_envs, bool)
        self._paths: list[list[np.ndarray]] = [[] for _ in range(num_envs)]  # if it renders

    @property  # type: ignore[misc] # the base class's can be set
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The environments' generators, as of `SyncVectorEnv`."""
        return tuple(generator for generator, _ in self._random)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seeds that they began with."""
        return tuple(seed for _, seed in self._random)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins episodes.

        Args:
            seed: s gives the environments the seeds s, s + 1, ..; or a list with one for each;
                None: they go on from the episodes before.
            options: `task` and `split`, as for the whole, for these episodes; `reset_mask`, bool
                [n], the environments that are meant.

        Returns:
            Observations [n, O], and info as after a step, of those that were reset.

        Raises:
            ResetNeeded: only some are meant, and the others never began.
            ValueError: an unknown option or task.
        """
        known = check_options(options, OPTIONS)
        mask = self._mask(known.pop("reset_mask", None))
        for i, one in enumerate(self._seeds(seed)):
            if one is not None and mask[i]:
                self._random[i] = seeding.np_random(one)
        self._begin(mask, [{**known, "task": one} for one in self._each(known.get("task"))])
        obs, _, _, info = self._told()
        self._remember(obs, mask)
        return obs, masked(info, mask)

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Acts with physical actions [n, A].

        Returns:
            Observations [n, O], rewards [n] float64, terminated [n] bool, truncated [n] bool, and
            info: what a single environment tells, as arrays [n], with Gymnasium's masks (`_task`,
            `_success`, ..).

        Raises:
            ResetNeeded: no episodes have begun, or one has ended and nothing resets it.
            ValueError: the actions have another shape, or are not finite.
        """
        if self._states is None or (self._mode is AutoresetMode.DISABLED and self._ended.any()):
            raise ResetNeeded("an episode has not begun, or it has ended: reset() begins one")
        checked = checked_action(actions, (self.num_envs, self.family.action_size))
        self._states = self._programs.step(self._states, checked)
        self._t += 1
        if self._mode is AutoresetMode.NEXT_STEP and self._ended.any():
            self._begin(self._ended)
        obs, reward, terminated, info = self._told()
        truncated = ~terminated & (self._t >= self.family.horizon)
        self._ended, final = terminated | truncated, {}
        if self._mode is AutoresetMode.SAME_STEP and self._ended.any():
            final = last_words(obs, info, self._ended)
            self._begin(self._ended)
            obs, _, _, info = self._told()
        everyone = np.ones(self.num_envs, bool)
        self._remember(obs, everyone)
        return obs, reward, terminated, truncated, {**final, **masked(info, everyone)}

    def render(self) -> Any:
        """A picture of each episode, [height, width, 3] uint8 each.

        Raises:
            ResetNeeded: no episodes have begun.
        """
        if self._painter is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array' when it is made")
            return None
        if self._states is None:
            raise ResetNeeded("there is nothing to render before reset()")
        paint, tasks = self._painter.paint, self._tasks
        return tuple(paint(np.stack(path), take(tasks, i)) for i, path in enumerate(self._paths))

    def close_extras(self, **_: Any) -> None:
        """Frees what renders."""
        if self._painter is not None:
            self._painter.close()

    def _begin(self, mask: np.ndarray, options: Sequence[dict[str, Any]] | None = None) -> None:
        """Begins episodes in the chosen environments."""
        seeds = np.zeros(self.num_envs, np.uint32)
        starts = {
            i: self._choices[i].draw(self._random[i][0], options[i] if options else {})
            for i in map(int, np.flatnonzero(mask))
        }
        for i, start in starts.items():
            seeds[i], self._paths[i] = start.seed, []
            for field, value in zip(self._tasks, start.task, strict=True):
                field[i] = value
        fresh = self._programs.reset(seeds, self._tasks)
        self._states = fresh if self._states is None else replaced(self._states, mask, fresh)
        self._t[mask] = 0
        self._ended = self._ended & ~mask

    def _told(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Observations, rewards, whether the environments have ended episodes, and info."""
        states = self._states
        obs, reward, done, metrics = jax.device_get(
            (states.obs, states.reward, states.done, states.metrics)
        )
        info = information(self._tasks, metrics)
        return np.array(obs), np.array(reward, np.float64), done > 0, info

    def _remember(self, obs: np.ndarray, mask: np.ndarray) -> None:
        if self._painter is not None:
            for i in np.flatnonzero(mask):
                self._paths[i].append(obs[i].copy())

    def _each(self, given: Any) -> Sequence[Any]:
        """What is given for all environments, or in a list one by one."""
        if not isinstance(given, list | np.ndarray):
            return [given] * self.num_envs
        if len(given) != self.num_envs:
            raise ValueError(f"{len(given)} are given for {self.num_envs} environments: {given}")
        return list(given)

    def _seeds(self, seed: Any) -> Sequence[int | None]:
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(self.num_envs)]
        return self._each(seed)

    def _mask(self, given: Any) -> np.ndarray:
        """Which environments a reset is for."""
        if given is None:
            return np.ones(self.num_envs, bool)
        mask = np.asarray(given)
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask={given!r} is not allowed: {self.num_envs} truth values")
        if self._states is None and not mask.all():
            raise ResetNeeded("at first all environments are reset")
        return mask
