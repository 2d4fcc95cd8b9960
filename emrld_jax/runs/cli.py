"""The command line: Hydra's `key=value` syntax, and one clear message for what is wrong with it."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

import jax
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from emrld_jax import algorithms
from emrld_jax.demos import DemoError
from emrld_jax.runs.config import (
    PATHS,
    PLACES,
    RESUMABLE,
    VARIED,
    ConfigError,
    EvaluateConfig,
    TrainConfig,
    check_config,
    load_config,
    updated,
)
from emrld_jax.runs.folder import run_folders
from emrld_jax.runs.usage import Leaf, leaves
from emrld_jax.settings import allowed_values

__all__ = ["evaluate_config", "parse", "run_command", "train_config", "updated"]

CONF = Path(__file__).parents[1] / "conf"

# what memory grows with
SIZES = ("num_seeds", "adapt.num_episodes", "env.horizon", "policy.hidden_sizes")
VMAP = "vmap."  # before the name of a setting: values that are trained side by side

Values = dict[str, Any]


def groups() -> dict[str, tuple[str, ...]]:
    """The configuration groups and what each offers."""
    folders = sorted(path for path in CONF.iterdir() if path.is_dir())
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


def parse(arguments: Sequence[str], schema: Any, options: dict[str, tuple[str, ...]]) -> Values:
    """Values by setting or group, each known and of the right type.

    Args:
        arguments: `key=value` each.
        schema: a settings object.
        options: what each configuration group offers.

    Raises:
        ConfigError: names what is wrong and what is allowed.
    """
    known = leaves(schema)
    values: Values = {}
    for argument in arguments:
        key, value = _parse_one(argument)
        if key in values:
            raise ConfigError(f"{argument}: {key} is given twice")
        if key in options:
            _check_option(key, value, options[key])
        elif key.startswith(VMAP) and "vmap" in known:
            _check_varied(argument, key, value)
        else:
            _check_setting(argument, key, value, known, tuple(options))
        values[key] = value
    return values


def run_command(main: Callable[[], int]) -> NoReturn:
    """Runs a command and exits; what the user can mend is told in one message, no traceback."""
    _keep_compiled_programs()
    try:
        code = main()
    except (ConfigError, DemoError, OSError) as error:
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
    except BaseException:
        if not jax.distributed.is_initialized():
            raise
        traceback.print_exc()
        code = 1
    if code and jax.distributed.is_initialized():
        sys.stdout.flush()
        os._exit(code)  # at once: an ordinary exit waits for the other processes
    sys.exit(code)


def _keep_compiled_programs() -> None:
    """Lets JAX keep what it compiles in the user's cache folder, unless told another place."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(cache):  # a user without a home has none
        jax.config.update("jax_compilation_cache_dir", os.path.join(cache, "emrld_jax/compiled"))


def _parse_one(argument: str) -> tuple[str, Any]:
    """The name and the value of an argument."""
    key, equals, text = argument.partition("=")
    if key in PATHS and equals:
        return key, None if text == "null" else text
    override = _parse_override(argument)
    return override.key_or_group, override.value()


def _parse_override(argument: str) -> Override:
    try:
        override = OverridesParser.create().parse_override(argument)
    except HydraException as error:
        raise ConfigError(
            f"{argument!r} is not of the form setting=value, without dashes or spaces "
            "(--help lists the settings)"
        ) from error
    if override.type is not OverrideType.CHANGE or override.package is not None:
        raise ConfigError(f"{argument!r}: only the form setting=value is allowed")
    if override.is_sweep_override():
        raise ConfigError(
            f"{argument!r}: one value at a time (quote a text with a comma; a list is [1,2])"
        )
    return override


def _check_option(group: str, value: Any, offered: tuple[str, ...]) -> None:
    if value not in offered:
        hint = did_you_mean(str(value), offered)
        raise ConfigError(f"{group}={value} is unknown{hint} (there are: {', '.join(offered)})")


def _check_setting(
    argument: str, key: str, value: Any, known: dict[str, Leaf], option_names: tuple[str, ...]
) -> None:
    if key == "env.name":
        raise ConfigError(f"{argument}: choose an environment by env={value}, with its defaults")
    if key not in known:
        inside = [name for name in known if name.startswith(f"{key}.")]
        if inside:
            raise ConfigError(f"{argument}: {key} is a section; its settings: {', '.join(inside)}")
        hint = did_you_mean(key, (*known, *option_names))
        raise ConfigError(f"{argument}: there is no setting {key!r}{hint} (--help lists all)")
    leaf = known[key]
    if "choices" in leaf.metadata:
        _check_option(key, value, leaf.metadata["choices"])
    if key in PATHS and value == "":
        raise ConfigError(f"{argument} is not allowed: a path must not be empty")
    if key in PATHS and value is not None:
        return  # any text
    if isinstance(value, str) and (value == "???" or "${" in value):
        raise ConfigError(f"{argument}: ??? and ${{..}} are not allowed; give the value itself")
    try:
        OmegaConf.update(OmegaConf.structured(leaf.section), leaf.name, value)
    except OmegaConfBaseException as error:
        allowed = ", ".join(filter(None, (leaf.type_words, allowed_values(leaf.metadata))))
        raise ConfigError(f"{argument} is not allowed: it must be {allowed}") from error


def _check_varied(argument: str, key: str, value: Any) -> None:
    """Refuses what cannot be trained side by side."""
    name = key.removeprefix(VMAP)
    if name not in VARIED:
        raise ConfigError(
            f"{argument}: {name} cannot differ between runs of one program"
            f"{did_you_mean(name, VARIED)}; these numbers can: {', '.join(VARIED)}. "
            "For others: python -m emrld_jax.sweep"
        )
    is_list = isinstance(value, list) and len(value) > 0
    if not is_list or not all(type(x) in (int, float) for x in value):
        raise ConfigError(f"{argument} is not allowed: it must be a list of numbers, as [0.2,0.5]")
    if len(set(value)) < len(value):
        raise ConfigError(f"{argument} is not allowed: a value is given twice")


def did_you_mean(wrong: str, known: Sequence[str]) -> str:
    """A hint at the closest known name; empty if none is close."""
    lower = {name.lower(): name for name in known}
    close = [lower[c] for c in get_close_matches(wrong.lower(), lower, n=1, cutoff=0.5)]
    if not close:  # the right name in the wrong section
        _, _, last = wrong.rpartition(".")
        close = [name for name in known if name.endswith(f".{last}")][:1]
    return f"; did you mean {close[0]!r}?" if close else ""


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
    config = load_config(run_folders(Path(directory))[0] / "config.yaml")
    allowed = (*RESUMABLE, *PLACES)
    for key in values:
        if key not in (*allowed, "resume"):
            raise ConfigError(
                f"{key} cannot be changed along with resume={directory}: the run continues as it "
                f"was; allowed: {', '.join(allowed)}"
            )
    return updated(config, values)
