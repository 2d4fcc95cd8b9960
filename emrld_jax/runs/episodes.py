"""Some episodes that a run keeps as it trains, before and after adaptation, to be looked at later.

`episodes/<iterations done>.npz` holds one episode of some training tasks, `episodes/final.npz`
several of all tasks of both splits. Nothing that is learned depends on them.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from emrld_jax.demos import DemoSet
from emrld_jax.meta.batching import map_each
from emrld_jax.runs.config import ConfigError, TrainConfig
from emrld_jax.runs.evaluation import Evaluation, evaluator
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.iteration import Standing, streams
from emrld_jax.runs.plane import is_planar
from emrld_jax.runs.setup import Setup, learner_with
from emrld_jax.runs.strides import is_runner
from emrld_jax.runs.variants import differences
from emrld_jax.settings import with_values
from envs_jax import Env

FORMAT, VERSION = "emrld-episodes", 1
FINAL = "final"  # the name of the file that a finished run has
SHARE = 0.02  # of the episodes that training takes, those that are taken to be kept
RUNS = 16  # of a command, that keep episodes: nobody looks at more
SOME = 3  # episodes a task in the final file
STREAM = 0x6B657074  # tells the keys of kept episodes from those of the final evaluation
ARRAYS = ("task", "aim", "path", "reward", "demo")


class KeptEpisodes(NamedTuple):
    """What is kept of one split: M tasks, 2 stages (before, after all steps), P episodes."""

    task: np.ndarray  # [M], number of the task in its split
    aim: np.ndarray  # [M, 2], the goal in m; [M, 1], the direction to run in, 1 or -1
    path: np.ndarray  # [M, 2, P, T + 1, 2]: x, y in m; or s, m from the start; NaN after the end
    reward: np.ndarray  # [M, 2, P, T], of the step that begins there; NaN after the end
    demo: np.ndarray  # [M, N, 2], as `path`


class EpisodeKeeper:
    """Keeps episodes of runs that train together."""

    def __init__(self, setups: Sequence[Setup], folders: Sequence[RunFolder]) -> None:
        shared = setups[0]
        self._env, self._folders = shared.env, list(folders[:RUNS] if can_keep(shared.env) else ())
        every = differences([setup.config for setup in setups])
        self._values = {name: column[: len(self._folders)] for name, column in every.items()}
        part = shared.demos.train
        self._numbers = some_tasks(shared.config, part.demos.mask.shape[0])
        self._part = jax.tree.map(lambda leaf: leaf[self._numbers], part)

        @jax.jit
        def evaluate(values: Any, params: Any, keys: jax.Array) -> Evaluation:
            def one(own: Any, params: Any, key: jax.Array) -> Evaluation:
                learner, settings = learner_with(shared, own), with_values(shared.config, own)
                evaluate = evaluator(shared.env, learner, settings.adapt, 1, kept=1)
                return evaluate(params, key, self._part.tasks, self._part.demos)

            return map_each(one, values, params, keys)

        self._evaluate = evaluate

    def keep(self, standing: Standing) -> None:
        """Adapts where the runs stand now, and writes a file for each that has none yet.

        Raises:
            OSError: a file cannot be written.
        """
        paths = [folder.episodes / f"{standing.iteration}.npz" for folder in self._folders]
        if all(path.is_file() for path in paths):  # also if there is none to write
            return
        runs = [standing.run(k) for k in range(len(paths))]
        params = jax.tree.map(lambda *leaves: np.stack(leaves), *(run.state.params for run in runs))
        keys = _keys(np.stack([run.key for run in runs]), standing.iteration)
        found = jax.device_get(self._evaluate(self._values, params, keys))
        for k, path in enumerate(paths):
            own = jax.tree.map(lambda leaf, k=k: leaf[k], found)
            kept = kept_episodes(self._env, self._part, own, self._numbers)
            write_episodes(path, self._env, {"train": kept}, standing.iteration)


@jax.jit
def _keys(key_data: jax.Array, iteration: int) -> jax.Array:
    """Keys that neither training nor the final evaluation uses, [K]."""

    def own(data: jax.Array) -> jax.Array:
        return jax.random.fold_in(jax.random.fold_in(streams(data)[2], STREAM), iteration)

    return jax.vmap(own)(key_data)


def can_keep(env: Env) -> bool:
    """Whether it is known how to draw the environment's episodes."""
    return is_planar(env) or is_runner(env)


def some_tasks(config: TrainConfig, tasks: int) -> np.ndarray:
    """Evenly spread numbers of tasks: so many that keeping takes SHARE of all episodes, or one."""
    adapt = config.adapt
    trained = config.checkpoint_every * tasks * adapt.num_episodes * (adapt.num_steps + 1)
    of_one_task = adapt.num_episodes * adapt.num_steps + adapt.num_steps + 1
    count = min(tasks, max(1, int(SHARE * trained / of_one_task)))
    return np.linspace(0, tasks - 1, count).round().astype(np.int32)


def kept_episodes(
    env: Env, demos: DemoSet, evaluation: Evaluation, numbers: Sequence[int] | np.ndarray
) -> KeptEpisodes:
    """What is kept of an evaluation of these tasks; `numbers` are theirs in the split."""
    ends = np.array([0, evaluation.obs.shape[1] - 1])
    obs, mask, reward = (
        np.asarray(leaf)[:, ends, :SOME]
        for leaf in (evaluation.obs, evaluation.mask, evaluation.rewards)
    )
    shown = demos.demos
    return KeptEpisodes(
        np.asarray(numbers, np.int32),
        _aims(env, demos.tasks),
        _rounded(_paths(env, obs, mask, is_planar(env))),
        _rounded(np.where(mask > 0, reward, np.nan)),
        _rounded(_paths(env, np.asarray(shown.obs), np.asarray(shown.mask), False)[..., :-1, :]),
    )


def _rounded(values: np.ndarray) -> np.ndarray:
    """Three digits, enough for a picture; what diverged so far is infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float16)


def _aims(env: Any, tasks: Any) -> np.ndarray:
    if is_planar(env):
        return np.asarray(jax.vmap(env.goal)(tasks), np.float32)
    return np.asarray(tasks.direction, np.float32)[:, None]


def _paths(env: Any, obs: np.ndarray, mask: np.ndarray, goes_on: bool) -> np.ndarray:
    """Where episodes were at each step. [.., T, O] -> [.., T + 1, 2].

    If what is observed goes on after an episode's end, as in a rollout but not in a demonstration,
    the next row is where its last action led.
    """
    steps = obs.shape[-2]
    points = np.full((*obs.shape[:-2], steps + 1, 2), np.nan)
    if is_planar(env):
        points[..., :-1, :] = obs[..., :2]
    else:
        x = obs[..., env.observation_names.index("torso_x")]
        points[..., :-1, 0] = env.dt * np.arange(steps)
        points[..., :-1, 1] = x - x[..., :1]
    last = mask.sum(axis=-1) - (not goes_on)
    points[np.arange(steps + 1) > last[..., None]] = np.nan
    return points


def write_episodes(
    path: Path, env: Any, splits: Mapping[str, KeptEpisodes], iteration: int
) -> None:
    """Writes a file, whole or not at all."""
    planar = is_planar(env)
    about = {
        "format": FORMAT,
        "version": VERSION,
        "iteration": iteration,
        "kind": "plane" if planar else "runner",
        "zone": env.reward_radius if planar else env.zone_distance,
    }
    arrays = {f"{s}/{name}": x for s, kept in splits.items() for name, x in kept._asdict().items()}
    path.parent.mkdir(exist_ok=True)
    partial = path.with_name(f"{path.name}.partial")
    with partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)
    os.replace(partial, path)


def read_episodes(path: Path) -> tuple[dict[str, Any], dict[str, KeptEpisodes]]:
    """What a file is about, and what it holds of each split.

    Raises:
        ConfigError: it cannot be read, or is not such a file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        about = json.loads(str(arrays.pop("about")))
        splits = dict.fromkeys(name.partition("/")[0] for name in arrays)
        kept = {
            split: KeptEpisodes(*(arrays[f"{split}/{name}"] for name in ARRAYS)) for split in splits
        }
        fits = (about["format"], about["version"]) == (FORMAT, VERSION)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, EOFError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from error
    if not fits:
        raise ConfigError(f"{path} is not of the format {FORMAT} {VERSION}")
    return about, kept


def drop_after(folder: RunFolder, iteration: int) -> None:
    """Deletes what is kept of later iterations, which are going to be done again."""
    for path in folder.episodes.glob("*.npz"):
        if path.stem == FINAL or not path.stem.isdecimal() or int(path.stem) > iteration:
            path.unlink()
