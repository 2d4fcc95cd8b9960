"""Configurations as files, and changed by full names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from emrld_jax.runs.config import PATHS, ConfigError, TrainConfig, check_config
from emrld_jax.runs.files import write_text

LATER = ("outer_demos",)  # settings that older runs lack: the default is what these did


def save_config(config: Any, path: Path) -> None:
    """Writes a configuration as YAML, every setting explicit."""
    write_text(path, yaml.safe_dump(asdict(config), sort_keys=False))


def load_config(path: Path) -> TrainConfig:
    """Reads what `save_config` wrote.

    Raises:
        ConfigError: no such file, or not a whole configuration.
    """
    if not path.parent.exists():
        raise ConfigError(f"{path.parent}: there is no such run folder")
    if not path.is_file():
        raise ConfigError(
            f"{path.parent} is not a run folder (such as runs/point2d/emrld-optimal/seed0): it has "
            f"no {path.name}"
        )
    try:
        values = by_full_name(yaml.safe_load(path.read_text()))
        _check_names(path, values)
        config = updated(TrainConfig(), values)
    except ConfigError:
        raise
    except (OmegaConfBaseException, yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{path}: {str(error).splitlines()[0]}") from error
    check_config(config)
    return config


def updated(config: Any, values: Mapping[str, Any]) -> Any:
    """A copy of a settings object with some values, by full name, changed; paths are literal.

    Raises:
        OmegaConfBaseException: a value is not of its setting's type.
    """
    own = [name for name in PATHS if hasattr(config, name)]
    paths = {name: values.get(name, getattr(config, name)) for name in own}
    node = OmegaConf.structured(replace(config, **dict.fromkeys(own, "")))
    for key, value in values.items():
        if key not in paths:
            OmegaConf.update(node, key, value)
    return replace(OmegaConf.to_object(node), **paths)  # type: ignore[type-var]


def by_full_name(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Leaves of nested mappings, such as meta.max_kl; anything else has none."""
    flat: dict[str, Any] = {}
    for key, value in tree.items() if isinstance(tree, dict) else ():
        inside = by_full_name(value, f"{prefix}{key}.")
        flat.update(inside or {f"{prefix}{key}": value})
    return flat


def _check_names(path: Path, values: Mapping[str, Any]) -> None:
    """Refuses a file that lacks a setting or has one too many: both would change the run."""
    known = by_full_name(asdict(TrainConfig()))
    for problem, names_ in (
        ("lacks", [name for name in known if name not in values and name not in LATER]),
        ("has unknown settings:", [name for name in values if name not in known]),
    ):
        if names_:
            more = f" and {len(names_) - 5} more" if len(names_) > 5 else ""
            raise ConfigError(
                f"{path} {problem} {', '.join(names_[:5])}{more}; it must have the settings of "
                "this version, no more and no fewer"
            )
    for name in PATHS:
        if name in known and not isinstance(values.get(name), str | type(known[name])):
            raise ConfigError(f"{path}: {name}={values[name]} is not allowed: it must be a text")
