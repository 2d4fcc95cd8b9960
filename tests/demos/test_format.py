"""The demonstration file: what is written is read, and whatever is wrong is refused."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from emrld_jax import demos
from emrld_jax.demos import DemoError, DemoFile, DemoSet
from emrld_jax.demos.shipped import QUALITIES
from emrld_jax.types import Demos

ENV = envs_jax.make("point2d")


def straight_walk(tasks) -> DemoSet:
    """Straight lines toward the goals, 18 to 20 steps of 0.1 m: 20 reach the goal."""
    goal = np.asarray(tasks.goal)
    lengths = 20 - np.arange(len(goal)) % 3
    step = 0.05 * goal  # 0.1 m toward the goal
    obs = np.zeros((len(goal), 20, 2), np.float32)
    action = np.zeros((len(goal), 20, 2), np.float32)
    mask = np.arange(20) < lengths[:, None]
    for i, length in enumerate(lengths):
        obs[i, :length] = np.arange(length)[:, None] * step[i]
        action[i, :length] = step[i] / 0.1
    recorded = Demos(jnp.asarray(obs), jnp.asarray(action), jnp.asarray(mask, jnp.float32))
    return DemoSet(recorded, tasks, *demos.replay(ENV, tasks, recorded))


@pytest.fixture(scope="module")
def file() -> DemoFile:
    train, test = straight_walk(ENV.train_tasks()), straight_walk(ENV.test_tasks())
    return DemoFile("point2d", "straight", train, test, {"seed": 3, "notes": "by hand"})


@pytest.fixture
def saved(file, tmp_path) -> Path:
    path = tmp_path / "straight.npz"
    demos.save(path, file, ENV)
    return path


def contents(path: Path) -> tuple[dict, dict]:
    with np.load(path) as archive:
        arrays = {key: archive[key] for key in archive.files}
    return json.loads(str(arrays.pop("metadata"))), arrays


def rewrite(path: Path, about: dict, arrays: dict) -> None:
    np.savez(path, metadata=np.array(json.dumps(about)), **arrays)


def assert_refused(path: Path, *words: str, env=ENV) -> None:
    with pytest.raises(DemoError) as refusal:
        demos.load(path, env)
    for word in (str(path), *words):
        assert word in str(refusal.value)


def test_round_trip(file, saved) -> None:
    read = demos.load(saved, ENV)
    assert (read.environment, read.quality, read.start) == ("point2d", "straight", "reset")
    assert read.provenance == file.provenance
    for split in ("train", "test"):
        before, after = getattr(file, split), getattr(read, split)
        assert type(after.tasks) is type(ENV.train_tasks())
        for a, b in zip(before.demos, after.demos, strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(before.tasks.goal, after.tasks.goal)
        np.testing.assert_array_equal(before.returns, after.returns)
        np.testing.assert_array_equal(before.success, after.success)


def test_what_the_file_says_can_be_read_with_numpy_alone(saved) -> None:
    about, arrays = contents(saved)
    assert (about["format"], about["version"], about["action_space"]) == (
        "emrld-demos",
        1,
        "policy",
    )
    assert about["observation_units"] == about["action_units"] == ["m", "m"]
    assert {key: value.shape for key, value in arrays.items() if key.startswith("train/")} == {
        "train/obs": (12, 20, 2),
        "train/action": (12, 20, 2),
        "train/length": (12,),
        "train/goal": (12, 2),
        "train/return": (12,),
        "train/success": (12,),
    }


def test_steps_after_the_end_are_written_as_zeros(file, tmp_path) -> None:
    train = file.train
    ended = 1 - train.demos.mask[..., None]
    dirty = train.demos._replace(
        obs=train.demos.obs + 5 * ended, action=train.demos.action + 9 * ended
    )
    path = tmp_path / "dirty.npz"
    demos.save(path, replace(file, train=train._replace(demos=dirty)), ENV)
    np.testing.assert_array_equal(demos.load(path, ENV).train.demos.obs, file.train.demos.obs)


def test_an_empty_test_split_is_allowed_and_an_empty_train_split_is_not(file, tmp_path) -> None:
    path = tmp_path / "f.npz"
    demos.save(path, replace(file, test=demos.empty(ENV)), ENV)
    assert demos.load(path, ENV).test.demos.obs.shape == (0, 1, 2)
    with pytest.raises(DemoError, match="train/length is empty"):
        demos.save(path, replace(file, train=demos.empty(ENV)), ENV)


def test_a_refused_save_leaves_the_old_file(file, saved) -> None:
    before = saved.read_bytes()
    wrong = file.train.demos._replace(action=file.train.demos.action * 20)
    with pytest.raises(DemoError, match="policy units"):
        demos.save(saved, replace(file, train=file.train._replace(demos=wrong)), ENV)
    with pytest.raises(DemoError, match="JSON"):
        demos.save(saved, replace(file, provenance={"x": object()}), ENV)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("train/obs", lambda x: x[:, :, :1], "(12, 20, 2)"),
        ("train/obs", lambda x: x.astype(np.float64), "float32"),
        ("train/obs", lambda x: x[0], "[M, N, O]"),
        ("train/obs", lambda x: x + np.float32(np.nan), "finite"),
        (
            "train/obs",
            lambda x: x + np.float32(0.01) * (np.arange(20) < 5)[:, None],
            "starts",
        ),
        ("train/action", lambda x: x[:11], "(12, 20, 2)"),
        ("train/action", lambda x: np.where(x != 0, np.float32(np.inf), x), "finite"),
        ("train/action", lambda x: x * np.float32(1.01), "policy units"),
        ("test/action", lambda x: np.where(x == 0, np.float32(1e-3), x), "padding"),
        ("train/length", lambda x: x * 0, "1 to 20"),
        ("train/length", lambda x: x + 1, "1 to 20"),
        ("train/length", lambda x: x.astype(np.int64), "int32"),
        ("train/length", lambda x: x.astype(np.float32), "int32"),
        ("test/goal", lambda x: x[:, :1], "(12, 2)"),
        ("test/goal", lambda x: x * np.float32(np.nan), "finite"),
        ("test/return", lambda x: x[:-1], "(12,)"),
        ("test/success", lambda x: x.astype(np.int32), "bool"),
    ],
)
def test_wrong_arrays_are_refused(saved, key, change, words) -> None:
    about, arrays = contents(saved)
    arrays[key] = change(arrays[key])
    rewrite(saved, about, arrays)
    assert_refused(saved, key, words)


def test_missing_and_extra_arrays_are_refused(saved) -> None:
    about, arrays = contents(saved)
    rewrite(saved, about, {k: v for k, v in arrays.items() if k != "test/goal"})
    assert_refused(saved, "test/goal is missing")
    rewrite(saved, about, {**arrays, "train/direction": arrays["train/return"]})
    assert_refused(saved, "train/direction is not part")


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("format", "other", "emrld-demos"),
        ("version", 2, "newer"),
        ("environment", "two_wheeled", "demonstrations of two_wheeled cannot teach point2d"),
        ("action_space", "physical", "'policy'"),
        ("observation_units", ["cm", "cm"], "observation_units"),
        ("action_names", ["dy", "dx"], "action_names"),
        ("start", "nowhere", "reset, anywhere"),
        ("quality", "", "quality"),
        ("provenance", "me", "provenance"),
    ],
)
def test_wrong_metadata_is_refused(saved, key, value, words) -> None:
    about, arrays = contents(saved)
    rewrite(saved, {**about, key: value}, arrays)
    assert_refused(saved, words)
    rewrite(saved, {k: v for k, v in about.items() if k != key}, arrays)
    assert_refused(saved)


def test_metadata_that_is_not_a_json_object_is_refused(saved) -> None:
    _, arrays = contents(saved)
    np.savez(saved, **arrays)
    assert_refused(saved, "no 'metadata'")
    for text in ("{", "[]", "[" * 100_000):
        np.savez(saved, metadata=np.array(text), **arrays)
        assert_refused(saved, "metadata")


def test_other_starts_need_to_be_declared(file, tmp_path) -> None:
    moved = file.train.demos._replace(
        obs=file.train.demos.obs + 0.5 * file.train.demos.mask[..., None]
    )
    path = tmp_path / "moved.npz"
    elsewhere = replace(file, train=file.train._replace(demos=moved))
    with pytest.raises(DemoError, match="anywhere"):
        demos.save(path, elsewhere, ENV)
    demos.save(path, replace(elsewhere, start="anywhere"), ENV)
    assert demos.load(path, ENV).start == "anywhere"


def test_files_that_are_no_archives_are_refused(saved, tmp_path) -> None:
    whole = saved.read_bytes()
    for part in (
        b"",
        b"PK",
        whole[: len(whole) // 2],
        pickle.dumps({"obs": [1]}),
        b"x" + whole[:99],
    ):
        saved.write_bytes(part)
        assert_refused(saved)
    damaged = bytearray(whole)
    damaged[len(whole) // 3] ^= 0xFF
    saved.write_bytes(damaged)
    assert_refused(saved)
    assert_refused(tmp_path / "absent.npz", "no such file")


def test_pickled_arrays_are_refused_without_loading_them(saved, tmp_path) -> None:
    class Payload:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    about, arrays = contents(saved)
    rewrite(saved, about, {**arrays, "train/obs": np.array([Payload()], dtype=object)})
    assert_refused(saved, "train/obs", "pickled")
    assert not (tmp_path / "ran").exists()


def npy(header: dict, data: bytes) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + data


@pytest.mark.parametrize("shape", [(2**40,), (2**20, 2**20, 2**20), (-1,), (3,)])
def test_a_header_that_claims_more_than_there_is_allocates_nothing(saved, shape) -> None:
    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
    with zipfile.ZipFile(saved, "w") as archive:
        archive.writestr("train/obs.npy", npy(header, bytes(8)))
    assert_refused(saved, "train/obs", "header")


def test_an_archive_that_expands_too_far_is_refused_before_expanding(saved) -> None:
    with zipfile.ZipFile(saved, "w", zipfile.ZIP_DEFLATED) as archive:
        block = bytes(2**20)
        with archive.open("train/obs.npy", "w") as member:
            for _ in range(257):
                member.write(block)
    assert saved.stat().st_size < 2**20
    assert_refused(saved, "at most")


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_members_that_are_not_arrays_of_their_own_are_refused(saved) -> None:
    for names in (["readme.txt"], ["train/obs.npy", "train/obs.npy"]):
        with zipfile.ZipFile(saved, "w") as archive:
            for name in names:
                archive.writestr(name, b"")
        assert_refused(saved, names[0])


def test_check_tasks(file) -> None:
    demos.check_tasks(file, ENV)
    turned = file.test.tasks._replace(goal=file.test.tasks.goal + jnp.array([[0.0, 2e-4]]))
    other = replace(file, test=file.test._replace(tasks=turned))
    demos.check_tasks(other, ENV, splits=("train",))
    demos.check_tasks(other, ENV, tolerance=1e-3)
    with pytest.raises(DemoError, match=r"test/goal\[0\]"):
        demos.check_tasks(other, ENV)
    with pytest.raises(DemoError, match="12 test tasks"):
        demos.check_tasks(replace(file, test=demos.empty(ENV)), ENV)


def point2d_return(goal: np.ndarray, actions: np.ndarray) -> tuple[float, bool]:
    """The rules of the specification, in NumPy: displacement, reward zone 0.2, goal 0.02."""
    position, total = np.zeros(2), 0.0
    for t, action in enumerate(actions):
        displacement = 0.1 * action.astype(np.float64)
        displacement *= min(1.0, 0.1 / max(float(np.hypot(*displacement)), 1e-9))
        position = position + displacement
        distance = float(np.hypot(*(position - goal)))
        if distance <= 0.02:
            return total + 100 - t - 1, True
        total += 1 - distance if distance <= 0.2 else 0.0
    return total, False


def test_replay() -> None:
    """Against NumPy, with random walks to goals near the start and with actions out of bounds."""
    generator = np.random.default_rng(0)
    goal = generator.uniform(-0.3, 0.3, (40, 2)).astype(np.float32)
    toward = goal[:, None] / np.hypot(*goal.T)[:, None, None]
    action = (0.4 * toward + generator.normal(0, 0.5, (40, 30, 2))).astype(np.float32)
    length = generator.integers(1, 31, 40)
    mask = (np.arange(30) < length[:, None]).astype(np.float32)
    recorded = Demos(jnp.zeros((40, 30, 2)), jnp.asarray(action), jnp.asarray(mask))
    returns, success = demos.replay(ENV, type(ENV.train_tasks())(jnp.asarray(goal)), recorded)
    expected = [point2d_return(g, a[:n]) for g, a, n in zip(goal, action, length, strict=True)]
    np.testing.assert_allclose(returns, [total for total, _ in expected], atol=1e-4)
    np.testing.assert_array_equal(success, [reached for _, reached in expected])
    assert 0 < success.sum() < 40


def test_replay_of_a_worked_walk() -> None:
    """20 steps straight to the goal: 0.9 at step 18 (0.1 m short), then success, 100 - 19 - 1."""
    tasks = type(ENV.train_tasks())(jnp.array([[0.0, 2.0]]))
    recorded = Demos(
        jnp.zeros((1, 20, 2)), jnp.tile(jnp.array([0.0, 1.0]), (1, 20, 1)), jnp.ones((1, 20))
    )
    returns, success = demos.replay(envs_jax.make("point2d", reward_radius=0.15), tasks, recorded)
    np.testing.assert_allclose(returns, [0.9 + 80.0], atol=1e-4)
    assert success.tolist() == [True]


def test_replay_of_nothing() -> None:
    none = demos.empty(ENV)
    returns, success = demos.replay(ENV, none.tasks, none.demos)
    assert returns.shape == success.shape == (0,)


def test_resolve(saved) -> None:
    assert demos.resolve(str(saved), "point2d") == saved
    with pytest.raises(DemoError, match="optimal, suboptimal, or a path"):
        demos.resolve("best", "point2d")
    with pytest.raises(DemoError, match="no such file"):
        demos.resolve("absent.npz", "point2d")
    with pytest.raises(DemoError, match="no optimal demonstrations of chess"):
        demos.resolve("optimal", "chess")


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("environment", envs_jax.names())
def test_shipped_files(environment: str, quality: str) -> None:
    """Every environment's files have its tasks, what a replay gives, and the quality they claim."""
    env = envs_jax.make(environment)
    shipped = demos.load(demos.resolve(quality, environment), env)
    assert shipped.quality == quality
    demos.check_tasks(shipped, env)
    for part in (shipped.train, shipped.test):
        chaotic = environment == "half_cheetah"  # a replay on another machine may end elsewhere
        returns, success = (recorded_runs if chaotic else demos.replay)(env, part.tasks, part.demos)
        np.testing.assert_allclose(returns, part.returns, atol=0.02)
        np.testing.assert_array_equal(success, part.success)
        if quality == "optimal":
            assert part.success.all()
        elif environment == "half_cheetah":
            assert not part.success.any()
            np.testing.assert_array_equal(part.returns, 0.0)
        elif environment == "point2d":
            assert not part.success.any()
            assert (end_distances(part) < 0.4).all()
        else:
            assert not part.success.all()


def recorded_runs(env: Any, tasks: Any, recorded: Demos) -> tuple[Any, Any]:
    """Sparse return and success of cheetahs, from where their torsos were recorded.

    Where the last step led is not recorded, and taken from the environment.
    """
    m, length = len(recorded.obs), np.asarray(recorded.mask).sum(axis=1).astype(int)
    x = np.append(np.asarray(recorded.obs)[..., 17], np.zeros((m, 1)), axis=1)
    for row, steps in enumerate(length):
        task = type(tasks)(tasks.direction[row])
        last = env.reset_to(recorded.obs[row, steps - 1], task)
        x[row, steps] = env.step(last, recorded.action[row, steps - 1]).obs[17]
    direction = np.asarray(tasks.direction)[:, None]
    way = x[:, 1:] - x[:, :1]
    cost = 0.05 * np.sum(np.asarray(recorded.action) ** 2, axis=-1)
    reward = np.where(np.abs(way) > 2, direction * np.diff(x, axis=1) / 0.05 - cost, 0.0)
    exists = np.asarray(recorded.mask)
    return np.sum(reward * exists, axis=1), np.any(direction * way * exists > 2, axis=1)


def end_distances(part: demos.DemoSet) -> np.ndarray:
    """How far from the goal Point2D's demonstrations end, m: the last position and its move."""
    last = np.asarray(part.demos.mask).sum(axis=1).astype(int) - 1
    rows = np.arange(len(last))
    moves = 0.1 * np.asarray(part.demos.action)[rows, last]
    ends = np.asarray(part.demos.obs)[rows, last] + moves
    return np.linalg.norm(ends - np.asarray(part.tasks.goal), axis=1)


def test_the_example_of_the_documentation(tmp_path, monkeypatch) -> None:
    page = Path(__file__).parents[2] / "docs" / "demonstrations.md"
    monkeypatch.chdir(tmp_path)
    exec(page.read_text().split("```python\n")[1].split("```")[0], {})
    read = demos.load("straight.npz", ENV)
    assert read.train.success.all()
    np.testing.assert_allclose(read.train.returns, 80.9, atol=1.0)
