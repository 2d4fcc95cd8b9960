"""Importing foreign files: nothing they name runs, and what they hold becomes our format."""

from __future__ import annotations

import builtins
import functools
import os
import pickle
from pathlib import Path
from typing import cast

import numpy as np
import pytest

import envs_jax
from emrld_jax import demos
from emrld_jax.demos import DemoError
from emrld_jax.demos.importers import import_file
from emrld_jax.demos.unpickle import read_pickle
from emrld_jax.import_demos import main
from emrld_jax.runs.cli import run_command

RESIDUAL = 0.3  # rad a step


class Calls:
    """Pickles as a call of `function`."""

    def __init__(self, function, *arguments) -> None:
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


def dump(path: Path, value, protocol: int = 2) -> Path:
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    return path


def mark(path: Path) -> None:
    path.touch()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickles_of_numbers_are_read(tmp_path, protocol) -> None:
    value = {
        "plain": [1, 2.5, None, True, "text", (3,)],
        "double": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.int32).reshape(2, 3)),
        "big_endian": np.arange(3, dtype=">f8"),
        "scalar": np.float32(1.5),
        "list": [np.ones(2), np.zeros(2)],
        "empty": np.zeros((0, 2)),
    }
    read = read_pickle(dump(tmp_path / "numbers.p", value, protocol))
    assert read["plain"] == value["plain"]
    for key in ("double", "fortran", "big_endian", "scalar", "list", "empty"):
        np.testing.assert_array_equal(np.asarray(read[key]), value[key])


@pytest.mark.parametrize("core", ["numpy.core", "numpy._core"])
def test_both_of_numpys_module_names_are_read(tmp_path, core) -> None:
    text = pickle.dumps(np.arange(3.0), protocol=0)
    here = b"numpy._core" if b"numpy._core" in text else b"numpy.core"
    path = tmp_path / "a.p"
    path.write_bytes(text.replace(here, core.encode()))
    np.testing.assert_array_equal(np.asarray(read_pickle(path)), [0, 1, 2])


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("kind", ["system", "eval", "partial", "nested", "own"])
def test_payloads_do_not_run(tmp_path, kind, protocol) -> None:
    ran = tmp_path / "ran"
    payload, name = {
        "system": (Calls(os.system, f"touch {ran}"), "system"),
        "eval": (Calls(builtins.eval, f"open({str(ran)!r}, 'w').close()"), "eval"),
        "partial": (functools.partial(mark, ran), "functools.partial"),
        "nested": ({0: {"state": [Calls(os.system, f"touch {ran}")]}}, "system"),
        "own": (Calls(mark, str(ran)), "mark"),
    }[kind]
    path = dump(tmp_path / "payload.p", payload, protocol)
    with pytest.raises(DemoError, match=f"payload.p.*{name}.*refused"):
        import_file(path, "point2d", "optimal")
    assert not ran.exists()
    if kind in ("system", "eval"):  # the same bytes do run where nothing holds them back
        pickle.loads(path.read_bytes())
        assert ran.exists()


@pytest.mark.parametrize(
    "value",
    [np.array([{}], dtype=object), np.array(["text"]), Calls(np.dtype, "O"), Calls(np.ndarray, 9)],
    ids=["objects", "text", "dtype", "allocation"],
)
def test_arrays_of_anything_but_numbers_are_refused(tmp_path, value) -> None:
    with pytest.raises(DemoError):
        read_pickle(dump(tmp_path / "a.p", value))


def test_an_entry_number_beyond_the_file_is_refused(tmp_path) -> None:
    """Nine bytes that would make a table of 2^24 entries: None, put as number 2^24, the end."""
    path = tmp_path / "large.p"
    path.write_bytes(b"\x80\x02Nr\x00\x00\x00\x01.")
    with pytest.raises(DemoError, match=r"large\.p.*16777216"):
        read_pickle(path)


def test_broken_pickles_are_refused(tmp_path) -> None:
    path = dump(tmp_path / "a.p", {"state": np.zeros((3, 2))})
    whole = path.read_bytes()
    for part in (b"", whole[:40], whole[:-1], b"not a pickle", b"PK\x03\x04"):
        path.write_bytes(part)
        with pytest.raises(DemoError, match=r"a\.p"):
            import_file(path, "point2d", "optimal")
    with pytest.raises(DemoError, match="larger"):
        read_pickle(path, max_bytes=1)
    with pytest.raises(DemoError, match="no such file"):
        read_pickle(tmp_path / "absent.p")


def drives(environment: str, count: int = 3, steps: int = 9) -> list[dict]:
    """Random commands, some out of bounds, and the poses before them, by the paper's formula."""
    generator = np.random.default_rng(7)
    low, high = (
        ([0, -2.84], [0.22, 2.84]) if environment == "two_wheeled" else ([0, -1.5], [0.15, 1.5])
    )
    residual = 0.0 if environment == "two_wheeled" else RESIDUAL
    recorded = []
    for i in range(count):
        command = generator.normal(0.1, [0.2, 2.0], (steps + i, 2))
        poses = [np.zeros(3)]
        for linear, angular in np.clip(command, low, high):
            x, y, theta = poses[-1]
            change = (0.5 * linear * np.cos(theta), 0.5 * linear * np.sin(theta))
            poses.append(np.array([x + change[0], y + change[1], theta + residual + 0.5 * angular]))
        task = {"goal_loc": [0.0, 2.0]} if environment == "two_wheeled" else {"drift": residual}
        recorded.append({"state": np.array(poses), "action": command, **task})
    return recorded


def aligned(entry: dict) -> dict:
    return {**entry, "state": entry["state"][:-1]}


def shifted(entry: dict, lost: int = 0) -> dict:
    """Rows as in the paper's sub-optimal TwoWheeled set; `lost` first rows were never stored."""
    return {**entry, "state": entry["state"][1 + lost :], "action": entry["action"][lost:]}


@pytest.mark.parametrize("environment", ["two_wheeled", "two_wheeled_drift"])
def test_rows_are_aligned_by_the_dynamics(tmp_path, environment) -> None:
    entries = drives(environment)
    good = import_file(
        dump(tmp_path / "a.p", {i: aligned(e) for i, e in enumerate(entries)}), environment, "x"
    )
    moved = import_file(dump(tmp_path / "b.p", [shifted(e) for e in entries]), environment, "x")
    assert (good.start, moved.start) == ("reset", "reset")
    assert moved.provenance["rows"].startswith("shifted")
    for entry, one, other in zip(entries, good.train.demos.obs, moved.train.demos.obs, strict=True):
        length = len(entry["action"])
        np.testing.assert_allclose(one[:length], entry["state"][:-1], atol=1e-5)
        np.testing.assert_allclose(other[:length], entry["state"][:-1], atol=1e-5)
    np.testing.assert_array_equal(good.train.demos.action, moved.train.demos.action)
    np.testing.assert_array_equal(good.train.returns, moved.train.returns)


def test_actions_become_bounded_policy_actions(tmp_path) -> None:
    """v in [0, 0.22] and omega in [-2.84, 2.84] map to [-1, 1]."""
    entry = drives("two_wheeled", 1)[0]
    out = import_file(dump(tmp_path / "a.p", [aligned(entry)]), "two_wheeled", "x").train.demos
    linear, angular = np.clip(entry["action"], [0, -2.84], [0.22, 2.84]).T
    np.testing.assert_allclose(
        out.action[0], np.stack([linear / 0.11 - 1, angular / 2.84], 1), atol=1e-5
    )


def test_where_the_first_rows_are_lost_the_first_action_goes(tmp_path) -> None:
    first, second, third = drives("two_wheeled")
    path = dump(tmp_path / "a.p", [shifted(first), shifted(second, lost=2), shifted(third)])
    out = import_file(path, "two_wheeled", "x")
    assert (out.start, out.provenance["dropped_rows"]) == ("anywhere", 1)
    assert np.asarray(out.train.demos.mask).sum(axis=1).tolist() == [9, 7, 11]
    np.testing.assert_allclose(out.train.demos.obs[1, :7], second["state"][3:-1], atol=1e-5)
    demos.save(tmp_path / "out.npz", out, envs_jax.make("two_wheeled"))


def test_steps_of_another_world_are_refused(tmp_path) -> None:
    entries = [aligned(e) for e in drives("two_wheeled")]
    entries[1]["state"][4, 2] += 0.01
    with pytest.raises(DemoError, match="dynamics"):
        import_file(dump(tmp_path / "a.p", entries), "two_wheeled", "x")


def padded(entries: list[dict]) -> dict:
    longest = max(len(e["action"]) for e in entries)
    rows = {
        key: np.stack([np.pad(e[key], [(0, longest - len(e[key])), (0, 0)]) for e in entries])
        for key in ("state", "action")
    }
    length = np.array([len(e["action"]) for e in entries])
    return {**rows, "length": length, "goal": np.array([e["goal_loc"] for e in entries])}


def test_padded_arrays_give_the_same_as_a_list(tmp_path) -> None:
    entries = [aligned(e) for e in drives("two_wheeled")]
    np.savez(tmp_path / "b.npz", **padded(entries))
    paths = (
        dump(tmp_path / "a.p", entries),
        tmp_path / "b.npz",
        dump(tmp_path / "c.p", padded(entries)),
    )
    first, *others = (import_file(path, "two_wheeled", "x").train for path in paths)
    for other in others:
        np.testing.assert_array_equal(first.demos.obs, other.demos.obs)
        np.testing.assert_array_equal(first.demos.action, other.demos.action)
        np.testing.assert_array_equal(first.demos.mask, other.demos.mask)
        np.testing.assert_array_equal(first.tasks.goal, other.tasks.goal)


@pytest.mark.parametrize(
    ("contents", "words"),
    [
        (3, "not demonstrations"),
        ({}, "no demonstrations"),
        ([3], "not a dictionary"),
        ([{"action": [[0, 0]], "goal": [0, 2]}], "allowed keys: state"),
        ([{"state": [[0, 0]], "action": [[0, 0]]}], "no goal"),
        ([{"state": [[0, 0]], "action": [[0]], "goal": [0, 2]}], "action has shape"),
        ([{"state": [[0, 0, 0]], "action": [[0, 0]], "goal": [0, 2]}], "state has shape"),
        ([{"state": [[0, np.nan]], "action": [[0, 0]], "goal": [0, 2]}], "finite"),
        ([{"state": [[0, "x"]], "action": [[0, 0]], "goal": [0, 2]}], "numbers"),
        ([{"state": [[0, 0]], "action": [[0, 0]], "goal": [0, 2, 4]}], "goal has shape"),
        ({"state": [[[0, 0]]], "action": [[[0, 0]]], "length": [2], "goal": [[0, 2]]}, "1 to 1"),
        ({"state": [[[0, 0]]], "action": [[[0, 0]]], "length": [0.5], "goal": [[0, 2]]}, "whole"),
        ({"state": [[[0, 0]]], "action": [[[0, 0]]], "length": [1], "goal": [0, 2]}, "one entry"),
    ],
)
def test_other_layouts_are_refused(tmp_path, contents, words) -> None:
    with pytest.raises(DemoError, match=words):
        import_file(dump(tmp_path / "a.p", contents), "point2d", "x")


def test_a_small_file_cannot_ask_for_much_memory(tmp_path) -> None:
    """Lists that name one list a thousand times each: a billion numbers in a few kilobytes."""
    bomb = [[[0.0] * 1000] * 1000] * 1000
    deep: list = []
    deep.append(deep)
    for state in (bomb, deep):
        source = dump(tmp_path / "a.p", [{"state": state, "action": [[0, 0]], "goal": [0, 2]}])
        assert source.stat().st_size < 30_000
        with pytest.raises(DemoError, match="more than 1000000 numbers"):
            import_file(source, "point2d", "x")


def command(monkeypatch, *arguments: str) -> int:
    """The exit code of `emrld_jax.import_demos`."""
    monkeypatch.setattr("sys.argv", ["import_demos", *arguments])
    with pytest.raises(SystemExit) as exit_:
        run_command(main)
    return cast(int, exit_.value.code)


def test_command(tmp_path, monkeypatch, capsys) -> None:
    source = dump(tmp_path / "a.p", [aligned(e) for e in drives("two_wheeled")])
    out = tmp_path / "demos" / "out.npz"
    words = [f"file={source}", "env=two_wheeled", "quality=mine", f"out={out}"]
    assert command(monkeypatch, *words) == 0
    assert "3 demonstrations of two_wheeled, 9 to 11 steps" in capsys.readouterr().out
    read = demos.load(out, envs_jax.make("two_wheeled"))
    assert (read.quality, len(read.test.success)) == ("mine", 0)
    before = out.read_bytes()
    assert command(monkeypatch, *words) == 2
    assert f"{out} exists" in capsys.readouterr().err
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["file=a.p", "env=two_weeled"], "did you mean 'two_wheeled'"),
        (["env=point2d"], "file=PATH is missing"),
        (["file=none.p", "out=sub/x.npz"], "none.p: there is no such file"),
        (["file=a.p", "env=two_wheeled", "out=x.pkl"], "must end in .npz"),
    ],
)
def test_what_the_command_refuses(tmp_path, monkeypatch, capsys, words, told) -> None:
    source = dump(tmp_path / "a.p", [aligned(e) for e in drives("two_wheeled")])
    monkeypatch.chdir(tmp_path)
    assert command(monkeypatch, *words) == 2
    assert told in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    ("environment", "quality", "mean_return", "reached"),
    [
        ("point2d", "optimal", 80.9, 12),
        ("point2d", "suboptimal", 0.6, 0),
        ("two_wheeled", "optimal", 84.1, 24),
    ],
)
def test_the_papers_files(
    paper_demos, tmp_path, environment, quality, mean_return, reached
) -> None:
    """The returns that the specification measured, under this package's rewards."""
    env = envs_jax.make(environment)
    source = paper_demos / f"{environment}_{quality}.npz"
    demos.save(tmp_path / "out.npz", import_file(source, environment, quality), env)
    read = demos.load(tmp_path / "out.npz", env)
    demos.check_tasks(read, env, splits=("train",))
    assert float(read.train.returns.mean()) == pytest.approx(mean_return, abs=0.1)
    assert int(read.train.success.sum()) == reached
    assert read.start == "reset"


def test_the_papers_shifted_file(paper_demos, tmp_path) -> None:
    """Rows before the action, each obeying the dynamics; 14 recordings begin in mid-episode."""
    source = paper_demos / "two_wheeled_suboptimal.npz"
    out = import_file(source, "two_wheeled", "suboptimal")
    assert (out.start, out.provenance["dropped_rows"]) == ("anywhere", 14)
    demos.save(tmp_path / "out.npz", out, envs_jax.make("two_wheeled"))
    obs, action, mask = (np.asarray(x, np.float64) for x in out.train.demos)
    linear, angular = 0.11 * (action[..., 0] + 1), 2.84 * action[..., 1]
    x, y, theta = np.moveaxis(obs, -1, 0)
    change = (0.5 * linear * np.cos(theta), 0.5 * linear * np.sin(theta), 0.5 * angular)
    after = np.stack([x + change[0], y + change[1], theta + change[2]], axis=-1)
    both = mask[:, 1:] > 0
    np.testing.assert_allclose(after[:, :-1][both], obs[:, 1:][both], atol=1e-5)


def test_recordings_of_chaotic_contacts_are_refused(tmp_path) -> None:
    """Before they are read: their rows cannot be checked."""
    with pytest.raises(DemoError, match="half_cheetah's recordings cannot be imported"):
        import_file(tmp_path / "absent.npz", "half_cheetah", "optimal", command="")
