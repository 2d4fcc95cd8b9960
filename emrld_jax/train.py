"""Trains a meta-policy: `python -m emrld_jax.train env=point2d` (`--help` lists all settings)."""

from __future__ import annotations

import sys

from emrld_jax.runs import cli, help_texts
from emrld_jax.runs.launch import launch


def main() -> int:
    """Trains as the command line says."""
    arguments = sys.argv[1:]
    if help_texts.asks_for_help(arguments):
        print(help_texts.train_usage(arguments))
        return 0
    config = cli.train_config(arguments)
    if config.processes > 1:
        return launch(arguments, config.processes)
    # only now, since it imports orbax and matplotlib: wrong arguments are told at once
    from rich.console import Console  # noqa: PLC0415

    from emrld_jax.runs.training import train  # noqa: PLC0415

    return train(config, Console())


if __name__ == "__main__":
    cli.run_command(main)
