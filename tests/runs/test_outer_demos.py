"""Demonstrations that only the outer loss sees."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest
import yaml
from rich.console import Console

from emrld_jax.demos import DemoError, DemoFile, DemoSet, empty, save
from emrld_jax.runs.cli import train_config
from emrld_jax.runs.config import ConfigError
from emrld_jax.runs.folder import RunFolder
from emrld_jax.runs.iteration import Together, initial
from emrld_jax.runs.saved import load_config, save_config
from emrld_jax.runs.setup import Setup, set_up
from emrld_jax.runs.starting import Plan, begin, folder_of, planned
from envs_jax.point2d import Point2D
from tests.runs.conftest import TINY
from tests.runs.straight import straight_lines


def write_halves(path: Path, goals: Any = None, steps: int = 12) -> Path:
    """The first of 20 steps to the goals of three training tasks."""
    env = Point2D()
    whole = straight_lines(env, env.train_tasks().goal[:3] if goals is None else goals)
    first = jax.tree.map(lambda x: x[:, :steps], whole.demos)
    none = jnp.zeros(len(whole.returns))
    half = DemoSet(first, whole.tasks, none, none > 0)
    save(path, DemoFile("point2d", "half", half, empty(env), {"by": "a test"}), env)
    return path


@pytest.fixture
def halves(tmp_path: Path) -> Path:
    return write_halves(tmp_path / "halves.npz")


def configured(*arguments: str, algo: str = "meta_bc") -> Setup:
    return set_up(train_config(["env=point2d", f"algo={algo}", *TINY, *arguments]))


def first_metrics(*setups: Setup) -> list[dict[str, float]]:
    together = Together(setups, jax.devices()[:1])
    return together.iterate(together.begin([initial(setup) for setup in setups]))[1]


def test_the_same_ones_change_nothing_and_others_do(demos: Path, halves: Path) -> None:
    given = (f"demos={demos}", f"runs={halves.parent}")
    plain = configured(*given)
    (expected,) = first_metrics(plain)
    (same,) = first_metrics(configured(*given, f"outer_demos={demos}"))
    assert same == pytest.approx(expected, rel=1e-6)
    two = configured(*given, f"outer_demos={halves}")
    assert two.outer_demos is not None
    assert two.outer_demos.mask.shape == (3, 12)
    (other,) = first_metrics(two)
    episodes = [name for name in expected if name.startswith("adapt/")]
    assert [other[name] for name in episodes] == [expected[name] for name in episodes]
    assert abs(other["outer/loss"] / expected["outer/loss"] - 1) > 1e-3


def test_a_run_keeps_where_they_come_from_and_goes_on_with_them(demos: Path, halves: Path) -> None:
    runs = halves.parent / "runs"
    new = configured(f"demos={demos}", f"outer_demos={halves}", f"runs={runs}")
    console = Console(quiet=True)
    (plan,) = planned(new.config)
    folder = folder_of(plan, console)
    begin([plan], [folder], console)
    assert folder.path == runs / "point2d" / "meta_bc-lines-outer-halves" / "seed0"
    record = json.loads(folder.provenance.read_text())
    assert record["outer_demos"]["path"] == str(halves)
    assert record["outer_demos"]["sha256"] != record["demos"]["sha256"]

    def go_on() -> Plan:
        (plan,) = planned(train_config([f"resume={folder.path}"]))
        begin([plan], [folder], console)
        return plan

    assert go_on().setup.outer_path == halves
    resumed = json.loads(folder.provenance.read_text())["resumed"]
    assert resumed[0]["outer_demos"] == record["outer_demos"]
    write_halves(halves, steps=11)
    with pytest.raises(ConfigError, match=r"halves\.npz has changed since .* began"):
        go_on()


def test_runs_of_before_go_on(tmp_path: Path) -> None:
    """They have no such setting; the default is what they did."""
    config = train_config(["env=point2d", "algo=gmps"])
    path = tmp_path / "config.yaml"
    save_config(config, path)
    values = yaml.safe_load(path.read_text())
    assert values.pop("outer_demos", "missing") is None
    path.write_text(yaml.safe_dump(values))
    assert load_config(path) == config


def test_others_than_the_tasks_are_refused(demos: Path, tmp_path: Path) -> None:
    goals = Point2D().train_tasks().goal
    chosen = f"demos={demos}"
    turned = write_halves(tmp_path / "turned.npz", goals[1:4])
    with pytest.raises(DemoError, match=r"outer_demos=.*turned\.npz: train/goal\[0\] is \["):
        configured(chosen, f"outer_demos={turned}")
    more = write_halves(tmp_path / "more.npz", goals[:4])
    with pytest.raises(DemoError, match=r"of 4 tasks, but demos has 3 train tasks"):
        configured(chosen, f"outer_demos={more}")
    with pytest.raises(DemoError, match=r"outer_demos=.*nowhere\.npz: there is no such file"):
        configured(chosen, f"outer_demos={tmp_path / 'nowhere.npz'}")
    with pytest.raises(DemoError, match="outer_demos='best' is unknown; allowed: optimal"):
        configured(chosen, "outer_demos=best")
    with pytest.raises(DemoError, match="point2d cannot teach two_wheeled"):
        set_up(train_config(["env=two_wheeled", "algo=gmps", f"outer_demos={turned}"]))


@pytest.mark.parametrize("algo", ["emrld", "emrld_ws", "maml", "promp", "emaml", "reptile"])
def test_algorithms_whose_outer_loss_sees_none_refuse_them(algo: str) -> None:
    with pytest.raises(ConfigError, match=f"no effect with algo={algo}; it is for meta_bc, gmps"):
        train_config(["env=point2d", f"algo={algo}", "outer_demos=optimal"])


def test_an_evaluation_needs_them_no_more(
    demos: Path, halves: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from emrld_jax.runs import evaluate_run
    from emrld_jax.runs.cli import evaluate_config

    folder = RunFolder(halves.parent / "run")
    folder.path.mkdir()
    new = configured(f"demos={demos}", f"outer_demos={halves}")
    save_config(new.config, folder.config)
    halves.unlink()
    monkeypatch.setattr(evaluate_run, "_demonstrations", lambda config, setup: setup)
    monkeypatch.setattr(evaluate_run, "other_demonstrations", lambda *_: "")
    with pytest.raises(ConfigError, match="has no checkpoint yet"):  # so far it comes
        evaluate_run.evaluate_run(evaluate_config([f"run={folder.path}"]), Console(quiet=True))
