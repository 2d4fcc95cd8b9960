"""Runs that Hydra's launchers start."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from tests.conftest import Command


@pytest.mark.parametrize("launcher", ["basic", "joblib", "submitit_local"])
def test_hydras_launchers_carry_out_a_sweep(
    command: Command, start: tuple[str, ...], tmp_path: Path, launcher: str
) -> None:
    known = {text.partition("=")[0]: text for text in (*start, "meta.iterations=1")}
    swept = ("seed=0,1", "w_bc=0.5", f"hydra/launcher={launcher}")
    done = command("sweep", *known.values(), *swept, f"runs={tmp_path}")
    assert done.returncode == 0, done.stderr
    parent = tmp_path / "point2d" / "emrld-lines"
    for seed in (0, 1):
        config = yaml.safe_load((parent / f"seed{seed}" / "config.yaml").read_text())
        assert (config["seed"], config["w_bc"]) == (seed, 0.5)
        assert (parent / f"seed{seed}" / "results.json").is_file()


@pytest.mark.parametrize("argument", ["vmap.w_rl=[0.1,0.2]", "processes=2", "resume=runs"])
def test_a_sweep_refuses_what_is_for_one_program(command: Command, argument: str) -> None:
    done = command("sweep", "seed=0,1", argument)
    assert done.returncode == 2
    assert "is for one program" in done.stderr


def test_a_sweep_is_checked_before_any_run_starts(command: Command, tmp_path: Path) -> None:
    done = command("sweep", "seed=0,1", "meta.max_kl=0.01,-1", f"runs={tmp_path}")
    assert done.returncode == 2
    assert "meta.max_kl=-1.0 is not allowed" in done.stderr
    assert not any(tmp_path.iterdir())
