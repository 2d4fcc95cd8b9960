"""Exports a run's policy for robots: `python -m emrld_jax.export run=RUN_DIR` (`--help`)."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from bridges.messages import BridgeError
from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.config import ConfigError, check_config
from emrld_jax.runs.help_texts import asks_for_help
from emrld_jax.runs.outputs import check_new
from emrld_jax.runs.usage import usage

BUNDLE, ONNX = ".safetensors", ".onnx"


@dataclass
class ExportConfig:
    """All settings of an export."""

    run: str | None = setting(None, "run folder whose policy is exported; required")
    out: str = setting(
        "policy.safetensors", f"file to write: a bundle ({BUNDLE}), or the network alone ({ONNX})"
    )
    split: str = setting(
        "test",
        "whose task: training, or held-out ones of the demonstrations",
        choices=("train", "test"),
    )
    task: int | None = setting(
        None,
        "which of these tasks, from 0; null: two_wheeled_drift's -0.65 rad a step, of others 0",
        at_least=0,
    )
    demos: str | None = setting(
        None,
        "demonstrations of the same environment, which say what tasks there are; null: the run's",
    )


def main() -> int:
    """Exports as the command line says."""
    arguments = sys.argv[1:]
    if asks_for_help(arguments):
        print(
            usage(
                "emrld_jax.export",
                "Write a run's policy, and what adapting it needs, into a file that robots read.",
                (
                    "run=runs/two_wheeled_drift/emrld-optimal/seed0 out=policy.safetensors",
                    "run=runs/point2d/emrld_ws-optimal/seed0 split=train task=3 out=point.onnx",
                ),
                ExportConfig(),
                {},
            )
        )
        return 0
    config = cli.updated(ExportConfig(), cli.parse(arguments, ExportConfig(), {}))
    check_config(config)
    if not config.run:
        raise ConfigError("run=RUN_DIR is missing: the folder of the run to export")
    check_new(Path(config.out), BUNDLE, ONNX)
    try:
        return write(config, Path(config.out))
    except BridgeError as error:
        raise ConfigError(str(error)) from error


def write(config: ExportConfig, out: Path) -> int:
    """Makes the bundle and writes it, or its network, and tells what it is."""
    # only now, since it imports orbax: wrong arguments are told at once
    from rich.console import Console  # noqa: PLC0415

    from bridges import bundle, exporting, onnx_file  # noqa: PLC0415
    from bridges.files import write_bytes  # noqa: PLC0415
    from emrld_jax.runs.progress import tell  # noqa: PLC0415

    console = Console()
    if out.suffix == ONNX:
        onnx_file.check_installed()
    exported = exporting.export(
        str(config.run), config.split, config.task, config.demos, lambda text: tell(console, text)
    )
    if out.suffix == ONNX:
        model = onnx_file.model(exported.bundle)
        exporting.check_agreement(exported, onnx_file.runner(model), "onnxruntime")
        write_bytes(out, model)
    else:
        bundle.write(out, exported.bundle)
    tell(console, f"{out}: {exporting.told(exported.bundle)}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
