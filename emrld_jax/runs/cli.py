"""The command line: Hydra's `key=value` syntax, and one clear message for what is wrong with it."""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import jax
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from emrld_jax import algorithms
from emrld_jax.demos import DemoError
from emrld_jax.runs.config import (
    PATHS,
    PLACES,
    RESUMABLE,
    ConfigError,
    EvaluateConfig,
    TrainConfig,
    check_config,
)
from emrld_jax.runs.folder import run_folders
from emrld_jax.runs.machines import ProcessLostError
from emrld_jax.runs.overrides import VMAP, Values, parse
from emrld_jax.runs.saved import load_config, updated
from envs_jax.physics.models import MissingPackageError

__all__ = ["evaluate_config", "parse", "run_command", "train_config", "updated"]

CONF = Path(__file__).parents[1] / "conf"
TUNED = "tuned"  # a group that the environment and the algorithm choose from

# what memory grows with
SIZES = ("num_seeds", "vmap", "adapt.num_episodes", "env.horizon", "policy.hidden_sizes")


def groups() -> dict[str, tuple[str, ...]]:
    """The configuration groups that can be chosen, and what each offers."""
    folders = sorted(path for path in CONF.iterdir() if path.is_dir() and path.name != TUNED)
    return {f.name: tuple(sorted(path.stem for path in f.glob("*.yaml"))) for f in folders}


def train_config(arguments: Sequence[str]) -> TrainConfig:
    """The configuration that the arguments of `emrld_jax.train` describe.

    Raises:
        ConfigError: names what is wrong and what is allowed.
    """
    values = parse(arguments, TrainConfig(), groups())
    config = _resumed(values) if values.get("resume") else _composed(arguments, values)
    check_config(config)
    _check_used(config.algo, values)
    return config


def evaluate_config(arguments: Sequence[str]) -> EvaluateConfig:
    """The configuration that the arguments of `emrld_jax.evaluate` describe.

    Raises:
        ConfigError: names what is wrong and what is allowed.
    """
    values = parse(arguments, EvaluateConfig(), {})
    if not values.get("run"):
        raise ConfigError("run=RUN_DIR is missing: the folder of the run to evaluate")
    trained = load_config(Path(values["run"]) / "config.yaml")
    config = updated(EvaluateConfig(adapt=trained.adapt), values)
    check_config(config)
    _check_used(trained.algo, values)
    return config


def _check_used(algo: str, values: Values) -> None:
    """Refuses settings that the algorithm has no use for."""
    for key in values:
        setting = key.removeprefix(VMAP)
        if not algorithms.uses(algo, setting):
            users = ", ".join(name for name in algorithms.names() if algorithms.uses(name, setting))
            raise ConfigError(f"{key} has no effect with algo={algo}; it is for {users}")


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """Where in the code a warning comes from is of no use to who typed a command."""
    print(f"warning: {message}", file=sys.stderr, flush=True)


def run_command(main: Callable[[], int]) -> NoReturn:
    """Runs a command and exits; what the user can mend is told in one message, no traceback."""
    _keep_compiled_programs()
    warnings.showwarning = _show_warning
    try:
        code = main()
    except ProcessLostError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 1
    except (ConfigError, DemoError, MissingPackageError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except (jax.errors.JaxRuntimeError, MemoryError) as error:
        reason = (str(error).splitlines() or ["memory ran out"])[0]
        advice = f"if memory ran out, smaller {', '.join(SIZES)} need less"
        print(f"error: {reason} ({advice})", file=sys.stderr)
        code = 1
    except KeyboardInterrupt:
        print("interrupted; what was saved before is kept", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(130)  # at once: an ordinary exit crashes while a compiled program goes on
    except Exception:
        if not jax.distributed.is_initialized():
            raise
        traceback.print_exc()
        code = 1
    else:
        sys.exit(code)
    if jax.distributed.is_initialized():
        sys.stdout.flush()
        os._exit(code)  # at once: an ordinary exit waits for the other processes
    sys.exit(code)


def _keep_compiled_programs() -> None:
    """Lets JAX keep what it compiles in the user's cache folder, unless told another place."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(cache):  # a user without a home has none
        folder = os.path.join(cache, "emrld_jax/compiled")
        jax.config.update("jax_compilation_cache_dir", folder)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder  # for processes that this one starts


def _composed(arguments: Sequence[str], values: Values) -> TrainConfig:
    """The configuration of a new run: groups of defaults, then the arguments."""
    ConfigStore.instance().store(name="train_schema", node=TrainConfig)
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            overrides = [text for text in arguments if _is_for_hydra(text)]
            config: Any = OmegaConf.to_object(compose("train", overrides=overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    vmap = {
        key.removeprefix(VMAP): [float(x) for x in value]
        for key, value in values.items()
        if key.startswith(VMAP)
    }
    for name in vmap:
        if name in values:
            raise ConfigError(f"{name} and {VMAP}{name} are both given")
    paths = {key: value for key, value in values.items() if key in PATHS}
    return replace(config, **paths, vmap=vmap)


def _is_for_hydra(argument: str) -> bool:
    """Paths and vmap are not: the first are literal, the second are not known to its schema."""
    key = argument.partition("=")[0]
    return key not in PATHS and not key.startswith(VMAP)


def _resumed(values: Values) -> TrainConfig:
    """The configuration of the runs to continue, with what may be changed of it.

    Of several that began together it is that of the first; they differ in seeds and numbers.
    """
    directory = values["resume"]
    config = load_config(run_folders(directory)[0] / "config.yaml")
    allowed = (*RESUMABLE, *PLACES)
    for key in values:
        if key not in (*allowed, "resume"):
            raise ConfigError(
                f"{key} cannot be changed along with resume={directory}: the run continues as it "
                f"was; allowed: {', '.join(allowed)}"
            )
    return updated(config, values)
