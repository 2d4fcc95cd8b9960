"""Reading a trained run from Python."""

from __future__ import annotations

import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.trained import load_trained
from examples import adapt_trained_policy


def test_the_newest_parameters_are_loaded(whole_run: tuple[Path, str]) -> None:
    trained = load_trained(whole_run[0])

    last = json.loads((whole_run[0] / "metrics.jsonl").read_text().splitlines()[-1])
    squares = [np.sum(np.square(leaf)) for leaf in jax.tree.leaves(trained.params)]
    assert trained.iteration == last["iteration"] + 1
    assert np.sqrt(np.sum(squares)) == pytest.approx(last["outer/params_norm"], rel=1e-5)
    assert trained.setup.env.horizon == 20


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not a run folder"):
        load_trained(tmp_path)


def test_a_run_without_a_checkpoint_is_refused(whole_run: tuple[Path, str], tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_bytes((whole_run[0] / "config.yaml").read_bytes())

    with pytest.raises(ConfigError, match="has no checkpoint yet"):
        load_trained(tmp_path)


def test_the_example_adapts_a_run(
    whole_run: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    adapt_trained_policy.main(str(whole_run[0]), iterations=0, direction=90.0)

    before, after, _ = capsys.readouterr().out.splitlines()
    # dense: minus the distance, which starts at 2 m and changes by 0.1 m a step at most
    for line in (before, after):
        (value,) = map(float, re.findall(r"-?\d+\.\d", line))
        assert -61.0 < value < -19.0


def test_the_example_of_the_documentation(
    whole_run: tuple[Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "runs.md").read_text()
    code = page.split("```python\n")[1].split("```")[0]
    assert "runs/point2d/emrld-optimal/seed0" in code

    exec(code.replace("runs/point2d/emrld-optimal/seed0", str(whole_run[0])), {})

    x, y = map(float, re.findall(r"-?\d+\.\d*(?:e-?\d+)?", capsys.readouterr().out))
    assert np.hypot(x, y) <= 0.1 + 1e-6  # m, the longest step there is
