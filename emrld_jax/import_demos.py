"""Imports demonstrations from the paper's released files, and files laid out like them."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import envs_jax
from emrld_jax import demos
from emrld_jax.demos.importers import import_file


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; 0 if the file was written, 2 if it was refused."""
    parser = argparse.ArgumentParser(prog="python -m emrld_jax.import_demos", description=__doc__)
    parser.add_argument("file", metavar="FILE", help="pickle or .npz in the paper's layout")
    parser.add_argument("--env", required=True, help=", ".join(envs_jax.names()))
    parser.add_argument("--quality", required=True, help="optimal, suboptimal, or your own label")
    parser.add_argument("--out", required=True, type=Path, help="the demonstration file to write")
    words = sys.argv[1:] if argv is None else list(argv)
    arguments = parser.parse_args(words)
    if arguments.out.exists():
        print(f"error: {arguments.out} exists; choose another file", file=sys.stderr)
        return 2
    command = shlex.join(["python", "-m", "emrld_jax.import_demos", *words])
    try:
        file = import_file(arguments.file, arguments.env, arguments.quality, command)
        demos.save(arguments.out, file, envs_jax.make(arguments.env))
    except (demos.DemoError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{arguments.out}: {_summary(file)}")
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
    sys.exit(main())
