"""Imports demonstrations from the paper's released files, and files laid out like them."""

from __future__ import annotations

import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import envs_jax
from emrld_jax import demos
from emrld_jax.demos.importers import import_file
from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError, check_config
from emrld_jax.runs.help_texts import asks_for_help
from emrld_jax.runs.outputs import check_new
from emrld_jax.runs.usage import usage


@dataclass
class ImportDemosConfig:
    """All settings of importing demonstrations."""

    file: str | None = setting(None, "pickle or .npz in the paper's layout; required")
    env: str = setting("point2d", "the environment", choices=envs_jax.names())
    quality: str = setting("imported", "label to store: optimal, suboptimal, or your own")
    out: str | None = setting(None, "file to write; null: demos/ENV_QUALITY.npz")


def main() -> int:
    """Imports demonstrations as the command line says."""
    arguments = sys.argv[1:]
    if asks_for_help(arguments):
        print(
            usage(
                "emrld_jax.import_demos",
                "Turn the paper's released files, and files laid out like them, into this format.",
                ("file=Good_PN.p env=point2d quality=optimal out=demos/paper.npz",),
                ImportDemosConfig(),
                {},
            )
        )
        return 0
    config = cli.updated(ImportDemosConfig(), cli.parse(arguments, ImportDemosConfig(), {}))
    check_config(config)
    if not config.file:
        raise ConfigError("file=PATH is missing: the pickle or .npz file to import")
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", config.quality):
        raise ConfigError(
            f"quality={config.quality} is not allowed: it must be letters, digits, '_', '-' and '.'"
        )
    out = Path(config.out or f"demos/{config.env}_{config.quality}.npz")
    check_new(out, ".npz")
    command = shlex.join(["python", "-m", "emrld_jax.import_demos", *arguments])
    file = import_file(config.file, config.env, config.quality, command)
    demos.save(out, file, envs_jax.make(config.env))
    print(f"{out}: {_summary(file)}")
    return 0


def _summary(file: demos.DemoFile) -> str:
    """What was imported, in a few lines."""
    returns, success = np.asarray(file.train.returns), np.asarray(file.train.success)
    length = np.asarray(file.train.demos.mask).sum(axis=1).astype(int)
    about = file.provenance
    lines = [
        f"{len(returns)} demonstrations of {file.environment}, "
        f"{length.min()} to {length.max()} steps",
        f"  mean return {returns.mean():.1f}, goal reached in {success.sum()} of {len(success)}",
        f"  rows {about['rows']}; {about['dropped_rows']} first actions dropped",
        f"  starts: {file.start}",
    ]
    try:
        demos.check_tasks(file, envs_jax.make(file.environment), splits=("train",))
    except demos.DemoError as error:
        lines.append(f"  note: not the environment's training tasks ({error})")
    return "\n".join(lines)


if __name__ == "__main__":
    cli.run_command(main)
