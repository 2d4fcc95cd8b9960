"""Many runs through Hydra's launchers: `python -m emrld_jax.sweep env=point2d seed=0,1,2`.

Values with commas between them make a run for each combination. What carries the runs out is
`hydra/launcher=NAME`: one after another without it; `joblib`, `submitit_local`, `submitit_slurm` or
`ray` with an extra (docs/scaling.md). For example, two at a time on this machine:

    python -m emrld_jax.sweep hydra/launcher=joblib hydra.launcher.n_jobs=2 \\
        env=point2d seed=0,1,2,3 policy.activation=tanh,relu
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, RangeSweep
from hydra.errors import HydraException
from omegaconf import OmegaConf

from emrld_jax.runs import cli
from emrld_jax.runs.config import PATHS, ConfigError, TrainConfig
from emrld_jax.runs.overrides import VMAP
from emrld_jax.runs.provenance import TYPED
from emrld_jax.runs.setup import set_up

NAMED = ("env", "algo", "demos", "seed", *PATHS)  # what a run folder's name tells already
SIGNALED = 128  # and more: exit codes of a training that a signal has stopped
ALONE = ("resume", "processes")  # what a sweep has no use for
EXTRAS = {
    "joblib": "sweep",
    "submitit_local": "slurm",
    "submitit_slurm": "slurm",
    "ray": "ray",
    "ray_aws": "ray",
}


def main() -> int:
    """Composes the runs and hands them to the launcher."""
    arguments = sys.argv[1:]
    if not arguments or any(text in ("-h", "--help", "help") for text in arguments):
        print(__doc__)
        print("Settings are those of training: python -m emrld_jax.train --help")
        return 0
    swept = _checked(arguments)
    ConfigStore.instance().store(name="train_schema", node=TrainConfig)
    fixed = [key for key in _keys(arguments) if key not in swept or key in NAMED]
    sys.argv[1:] = [
        "--multirun",
        "hydra.sweep.dir=${runs}/sweeps/${now:%Y-%m-%d_%H-%M-%S}",  # Hydra's notes; runs have more
        "hydra.output_subdir=null",
        "hydra/job_logging=none",
        f"hydra.job.config.override_dirname.exclude_keys=[{','.join(fixed)}]",
        *arguments,
    ]
    _task()
    return 0


def _keys(arguments: Sequence[str]) -> list[str]:
    return [text.partition("=")[0] for text in arguments]


def _checked(arguments: Sequence[str]) -> list[str]:
    """The settings that are swept, once every value of each has been found to be allowed.

    Raises:
        ConfigError: names what is wrong and what is allowed.
    """
    for text in arguments:
        key, _, value = text.partition("=")
        if key == "hydra/launcher" and value in EXTRAS and not _is_installed(value):
            raise ConfigError(
                f"{text}: this launcher is not installed: pip install 'emrld-jax[{EXTRAS[value]}]'"
            )
        if key in ALONE or key.startswith((VMAP, "distributed.")):
            raise ConfigError(f"{text}: {key} is for one program, emrld_jax.train; not for a sweep")
    settings = dict(zip(_keys(arguments), arguments, strict=True))
    values = {key: _values(t) for key, t in settings.items() if not key.startswith("hydra")}
    first = {key: f"{key}={each[0]}" for key, each in values.items()}
    for key, each in values.items():
        for value in each:
            set_up(cli.train_config([*{**first, key: f"{key}={value}"}.values()]))
    if "num_seeds" in values and len(values.get("seed", ())) > 1:
        raise ConfigError("num_seeds makes runs of the seeds after seed: sweep over one of the two")
    return [key for key, each in values.items() if len(each) > 1]


def _values(argument: str) -> list[str]:
    """Each of the values that an argument sweeps over, or its one value."""
    try:
        override = OverridesParser.create().parse_override(argument)
    except HydraException as error:
        raise ConfigError(f"{argument!r} is not of the form setting=value,value,..") from error
    value = override.value()
    if isinstance(value, RangeSweep):
        return [str(x) for x in value.range()]
    if isinstance(value, ChoiceSweep):
        return list(override.sweep_string_iterator())
    return [argument.partition("=")[2]]


def _is_installed(launcher: str) -> bool:
    return find_spec(f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher") is not None


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def _task(node: Any) -> None:
    """One run; where it fails, so does its job."""
    from rich.console import Console  # noqa: PLC0415

    from emrld_jax.runs.training import train  # noqa: PLC0415

    config: Any = OmegaConf.to_object(node)
    job = HydraConfig.get()
    own = [text for text in job.overrides.task if not text.startswith("hydra")]
    os.environ[TYPED] = shlex.join(["python", "-m", "emrld_jax.train", *own])
    code = train(config, Console(), job.job.override_dirname)
    if code > SIGNALED:
        raise KeyboardInterrupt  # the others are not to begin
    if code:
        raise RuntimeError(f"training ended with exit code {code}")


if __name__ == "__main__":
    cli.run_command(main)
