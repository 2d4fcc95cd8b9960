"""Evaluates a run: `python -m emrld_jax.evaluate run=RUN_DIR` (`--help` lists all settings)."""

from __future__ import annotations

import sys

from emrld_jax.runs import cli, help_texts


def main() -> int:
    """Evaluates as the command line says."""
    arguments = sys.argv[1:]
    if help_texts.asks_for_help(arguments):
        print(help_texts.evaluate_usage(arguments))
        return 0
    config = cli.evaluate_config(arguments)
    # only now, since it imports orbax and matplotlib: wrong arguments are told at once
    from rich.console import Console  # noqa: PLC0415

    from emrld_jax.runs.evaluate_run import evaluate_run  # noqa: PLC0415

    return evaluate_run(config, Console())


if __name__ == "__main__":
    cli.run_command(main)
