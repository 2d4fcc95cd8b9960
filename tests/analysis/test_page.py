"""The report as a file: whole, self-contained, with everything that is to be told."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest

from emrld_jax.analysis.groups import group_runs
from emrld_jax.analysis.loading import load_runs
from emrld_jax.analysis.page import embedded, write_report
from emrld_jax.analysis.paths import ENDED, packed
from emrld_jax.report import main
from emrld_jax.runs.config import ConfigError
from tests.analysis.conftest import MakeRun, kept_episodes
from tests.conftest import Command
from tests.test_documentation import example

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


def report(folder: Path, out: Path) -> tuple[str, dict[str, Any]]:
    """The page and the data in it."""
    write_report(group_runs(load_runs([folder])), out)
    text = out.read_text()
    data = text.split('<script id="data" type="application/json">')[1].split("</script>")[0]
    return text, json.loads(data)


def test_the_page_needs_nothing_else(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("runs/a", episodes=True)
    text, _ = report(tmp_path / "runs", tmp_path / "report.html")
    addresses = set(re.findall(r"https?://[^\"'\s<]+", text))
    assert addresses == {"http://www.w3.org/2000/svg"}  # the name of a format, not fetched
    assert not re.search(r"@import|url\((?!#)|<link(?! rel=\"icon\" href=\"data:)|\bsrc=", text)
    assert "default-src 'none'" in text
    assert "/*" not in re.sub(r"/\*.*?\*/", "", text.split("<script id")[0])
    for mark in ("/*STYLE*/", "/*PROGRAM*/", "/*DATA*/"):
        assert mark not in text


def test_texts_from_files_cannot_become_markup(make_run: MakeRun, tmp_path: Path) -> None:
    path = make_run("runs/a")
    record = json.loads((path / "provenance.json").read_text())
    (path / "provenance.json").write_text(json.dumps({**record, "command": EVIL}))
    text, data = report(tmp_path / "runs", tmp_path / "report.html")
    assert "alert(1)</script>" not in text
    assert text.count("<script") == 2
    assert data["runs"][0]["command"] == EVIL
    assert json.loads(embedded(EVIL)) == EVIL


def test_what_the_page_tells(make_run: MakeRun, tmp_path: Path) -> None:
    for seed in (0, 1):
        make_run(f"runs/a b#{seed}", seed=seed, value=40.0 + 20 * seed)
    make_run("runs/other", algo="maml", w_rl=0.4)
    bad = make_run("runs/bad", seed=7)
    (bad / "results.json").unlink()
    _, data = report(tmp_path / "runs", tmp_path / "pages" / "report.html")
    emrld, maml = data["groups"]
    assert (emrld["label"], emrld["seeds"], maml["seeds"]) == ("emrld", [0, 1], [0])
    assert emrld["cells"]["train/return/after"] == {
        "value": 50,
        "low": 40,
        "high": 60,
        "seeds": 2,
    }
    assert maml["cells"]["train/return/after"]["low"] is None  # one seed has no interval
    assert set(emrld["curves"]) == {"iterations", "env_steps", "seconds"}
    assert emrld["curves"]["seconds"]["return/after"]["x"] == [2, 4, 6, 8]
    assert data["skipped"][0]["path"] == str(bad)
    assert "interrupted" in data["skipped"][0]["reason"]
    assert "fewer than 4 seeds" in str(data["notes"])
    differing = {row["name"]: row["values"] for row in data["settings"] if row["differs"]}
    assert differing == {"algo": ["emrld", "maml"], "w_rl": ["null", "0.4"]}
    for run in data["runs"]:
        assert {file["name"] for file in run["files"]} >= {"config.yaml", "results.json"}
        for file in run["files"]:
            assert (tmp_path / "pages" / unquote(file["link"])).resolve().is_file()


def test_paths_are_packed_without_loss_of_what_can_be_seen() -> None:
    kept = kept_episodes(0.5)
    own = packed(kept)
    numbers = np.frombuffer(base64.b64decode(own["path"]), "<i2").reshape(kept.path.shape)
    np.testing.assert_allclose(numbers * own["scale"], kept.path, atol=1e-3)
    demo = np.frombuffer(base64.b64decode(own["demo"]), "<i2").reshape(kept.demo.shape)
    assert (demo[1, 3:] == ENDED).all()
    assert (demo[0] != ENDED).all()
    rewarded = np.frombuffer(base64.b64decode(own["rewarded"]), np.uint8)
    assert rewarded.reshape(kept.reward.shape)[:, 1].tolist() == [[[0, 0, 1]]] * 2
    assert own["returns"] == [[[0.0], [0.5]]] * 2


def test_the_slider_ends_with_the_final_evaluation(make_run: MakeRun, tmp_path: Path) -> None:
    make_run("runs/a", episodes=True)
    _, data = report(tmp_path / "runs", tmp_path / "report.html")
    (drawn,) = data["drawn"]
    assert [frame["iteration"] for frame in drawn["frames"]] == [0, 2, 4]
    assert [frame["tasks"] for frame in drawn["frames"]] == [[0, 7]] * 3
    assert set(drawn["final"]) == {"train", "test"}
    assert (drawn["kind"], drawn["zone"]) == ("plane", 0.2)


def test_damaged_episodes_are_told_and_the_run_stays(make_run: MakeRun, tmp_path: Path) -> None:
    path = make_run("runs/a", episodes=True)
    (path / "episodes" / "2.npz").write_bytes(b"PK")
    _, data = report(tmp_path / "runs", tmp_path / "report.html")
    assert len(data["runs"]) == 1
    assert not data["drawn"]
    assert "2.npz cannot be read" in str(data["notes"])


def test_the_command(make_run: MakeRun, tmp_path: Path, command: Command) -> None:
    good = make_run("runs/a", episodes=True)
    final = good / "episodes" / "final.npz"
    final.write_bytes(final.read_bytes()[:100])
    bad = make_run("runs/b=c", seed=1)
    (bad / "results.json").unlink()
    out = tmp_path / "page.html"
    done = command("report", str(tmp_path / "runs/a"), str(bad), f"out={out}")
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.split())
    assert f"left out: {bad}: interrupted" in said
    assert "note: 1 of 1 lines have fewer than 4 seeds" in said
    assert f"note: {final} cannot be read" in said
    assert "1 run in 1 line" in said
    assert out.is_file()


def test_help_shows_commands_that_can_be_typed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["report", "--help"])
    assert main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert "Usage: python -m emrld_jax.report RUNS... [setting=value ...]" in lines
    examples = [line.strip() for line in lines if line.startswith("  python")]
    assert examples == [
        "python -m emrld_jax.report runs",
        "python -m emrld_jax.report runs/point2d other/runs out=point2d.html",
    ]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "no folder is given"),
        (("nowhere",), "nowhere: there is no such folder"),
        (("{folder}",), "no finished run in"),
        (("{folder}", "output=x"), "there is no setting 'output'; did you mean 'out'?"),
        (("{folder}", "out={folder}"), "is a folder; it must be the file to write"),
    ],
)
def test_what_is_wrong_with_a_command_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    given = [text.format(folder=tmp_path) for text in arguments]
    monkeypatch.setattr("sys.argv", ["report", *given])
    with pytest.raises(ConfigError, match=re.escape(said)):
        main()


def test_the_example_of_the_documentation(
    make_run: MakeRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for seed in (0, 1):
        make_run(f"runs/{seed}", seed=seed, value=30.0 + 20 * seed)
    monkeypatch.chdir(tmp_path)
    exec(example("docs/comparing.md"), {})
    assert "emrld Estimate(value=np.float64(30.0)" in capsys.readouterr().out  # of held-out tasks
    assert (tmp_path / "report.html").is_file()
