"""Bundles: what is written is read, by others too, and whatever is wrong is refused."""

from __future__ import annotations

import json
import os
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors
import safetensors.numpy

from bridges import bundle as bundles
from bridges.bundle import Bundle
from bridges.messages import BridgeError
from bridges.tensor_file import MAX_HEADER
from tests.bridges.bundles import a_bundle, content_hash, file_bytes, forged

WHOLE = a_bundle()
DATA = bundles.encode(WHOLE)
ABOUT: dict[str, Any] = json.loads(bundles.about_text(WHOLE))


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "new" / "policy.safetensors"
    bundles.write(path, WHOLE)
    return path


def assert_refused(data: bytes, *words: str) -> None:
    with pytest.raises(BridgeError) as refusal:
        bundles.decode(data)
    for word in words:
        assert word in str(refusal.value)


def changed(place: str, value: Any) -> dict[str, Any]:
    """What the bundle says, with another value at a place such as action.low."""
    about = json.loads(json.dumps(ABOUT))
    *sections, name = place.split(".")
    inside = about
    for section in sections:
        inside = inside[section]
    inside[name] = value
    return about


def with_tensor(name: str, tensor: np.ndarray | None) -> dict[str, np.ndarray]:
    tensors = dict(WHOLE.tensors)
    del tensors[name]
    return tensors if tensor is None else {**tensors, name: tensor}


def test_what_is_written_is_read(saved: Path) -> None:
    read = bundles.read(saved)

    assert read.content_sha256 == WHOLE.content_sha256 == ABOUT["content_sha256"]
    for name in Bundle.__dataclass_fields__:
        if name != "tensors":
            assert getattr(read, name) == getattr(WHOLE, name)
            assert type(getattr(read, name)) is type(getattr(WHOLE, name))
    assert read.tensors.keys() == WHOLE.tensors.keys()
    for name, tensor in WHOLE.tensors.items():
        np.testing.assert_array_equal(read.tensors[name], tensor)
        assert read.tensors[name].dtype == np.float32


def test_the_documentation_tells_all_entries_and_its_example_runs(
    saved: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "bridge" / "bundles.md").read_text()
    table = page.split("| entry | value |")[1].split("\n\n")[0]
    monkeypatch.chdir(saved.parent)
    exec(page.split("```python\n")[1].split("```")[0], {})

    told = {
        name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[1])
    }
    assert told == ABOUT.keys()
    linear, angular = map(float, capsys.readouterr().out.strip("[]\n").split())
    assert 0 <= linear <= 0.15
    assert -1.5 <= angular <= 1.5


def test_the_safetensors_library_reads_the_same(saved: Path) -> None:
    tensors = safetensors.numpy.load_file(saved)
    with safetensors.safe_open(saved, "np") as file:
        about = json.loads(file.metadata()["emrld"])

    assert tensors.keys() == WHOLE.tensors.keys()
    for name, tensor in WHOLE.tensors.items():
        np.testing.assert_array_equal(tensors[name], tensor)
    assert (about["format"], about["version"]) == ("emrld-policy", 1)
    assert about["task"] == {"residual_angular_velocity": -0.65}
    assert about["action"]["low"] == [0.0, -1.5]
    assert about["content_sha256"] == content_hash(about, tensors)


def test_what_the_safetensors_library_writes_is_read() -> None:
    data = safetensors.numpy.save(WHOLE.tensors, {"emrld": bundles.about_text(WHOLE)})

    assert bundles.decode(data).content_sha256 == WHOLE.content_sha256


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 8},
        {"task": {"residual_angular_velocity": -0.64}},
        {"zone": None},
        {"action": WHOLE.action._replace(high=[0.15, 1.6])},
        {"provenance": {}},
        {"tensors": with_tensor("policy/log_std", np.zeros(2, np.float32))},
    ],
)
def test_another_content_has_another_hash(change: dict[str, Any]) -> None:
    other = replace(WHOLE, **change)

    assert other.content_sha256 != WHOLE.content_sha256
    assert bundles.decode(bundles.encode(other)).content_sha256 == other.content_sha256


def test_a_forged_file_without_a_fault_is_read() -> None:
    """So that the refusals below are of the fault and nothing else."""
    assert bundles.decode(forged(ABOUT, WHOLE.tensors)).content_sha256 == WHOLE.content_sha256


def test_a_changed_limit_is_found() -> None:
    tampered = DATA.replace(b"0.15,1.5]", b"0.95,1.5]")

    assert tampered != DATA
    assert_refused(tampered, "damaged or changed")


def test_a_changed_weight_is_found() -> None:
    tampered = DATA[:-1] + bytes([DATA[-1] ^ 1])

    assert_refused(tampered, "damaged or changed")


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("format", "emrld-demos", "no bundle"),
        ("version", 2, "version 2"),
        ("version", True, "version True"),
        ("control_period", 0.0, "control_period is 0.0; it must be a number above 0"),
        ("control_period", "0.5", "a number above 0"),
        ("seed", -1, "seed"),
        ("algorithm", "", "algorithm"),
        ("task", {}, "task"),
        ("task", {"goal": ["2", 1]}, "task"),
        ("settings", [], "settings"),
        ("environment.name", None, "environment.name"),
        ("environment", "point2d", "environment must be a mapping"),
        ("observation.names", ["x", "y"], "observation.units must have 2 entries"),
        ("action.units", [], "action.units"),
        ("action.low", [0.0, 2.0], "must be below"),
        ("action.low", [0.0, 10**400], "action.low"),
        ("action.high", [0.15], "action.high must have 2 entries"),
        ("action.bounding", "ball", "one of box, norm"),
        ("action.bounding", "norm", "equal bounds"),
        ("policy.hidden_sizes", [0], "policy.hidden_sizes"),
        ("policy.hidden_sizes", [9], "shape (3, 8), not [3, 9]"),
        ("policy.hidden_sizes", [8, 8], "'meta/layer_2/bias' is missing"),
        ("policy.activation", "sine", "one of tanh, relu"),
        ("policy.squash", 1, "true or false"),
        ("stage.adapted", None, "stage.adapted"),
        ("stage.done", True, "stage.done is not part of a bundle"),
        ("zone.goal", [1.0], "two numbers"),
        ("zone.success", "round", "one of square, disc"),
        ("zone.reward_radius", -1, "zone.reward_radius"),
        ("zone", 3, "zone"),
        ("extra", 1, "extra is not part of a bundle"),
    ],
)
def test_what_makes_no_sense_is_refused(place: str, value: Any, words: str) -> None:
    assert_refused(forged(changed(place, value), WHOLE.tensors), words)


@pytest.mark.parametrize("name", [name for name in ABOUT if name != "content_sha256"])
def test_what_is_missing_is_told(name: str) -> None:
    about = {key: value for key, value in ABOUT.items() if key != name}

    assert_refused(forged(about, WHOLE.tensors), name)


@pytest.mark.parametrize(
    ("name", "tensor", "words"),
    [
        ("policy/layer_0/kernel", np.zeros((8, 3)), "shape (8, 3), not [3, 8]"),
        ("policy/layer_1/bias", np.zeros((1, 2)), "shape (1, 2), not [2]"),
        ("meta/log_std", None, "'meta/log_std' is missing"),
        ("demos/obs", np.zeros(3), "shape (3,), not [N, 3]"),
        ("demos/action", np.zeros((4, 2)), "shape (4, 2), not [N, 2]"),
        ("policy/layer_0/bias", np.full(8, np.nan), "not finite"),
        ("policy/layer_0/bias", np.full(8, -np.inf), "not finite"),
        ("policy/log_std", np.full(2, np.inf), "not finite"),
    ],
)
def test_wrong_tensors_are_refused(name: str, tensor: np.ndarray | None, words: str) -> None:
    tensors = with_tensor(name, tensor)

    assert_refused(forged(ABOUT, tensors), words)
    with pytest.raises(BridgeError, match="tensor"):
        bundles.encode(replace(WHOLE, tensors=tensors))


def test_an_empty_demonstration_and_another_tensor_are_refused() -> None:
    empty = {"demos/obs": np.zeros((0, 3)), "demos/action": np.zeros((0, 2))}

    assert_refused(forged(ABOUT, {**WHOLE.tensors, **empty}), "demos/obs")
    assert_refused(forged(ABOUT, {**WHOLE.tensors, "policy/x": np.zeros(1)}), "not part of")


def entry(**values: Any) -> dict[str, Any]:
    return {"dtype": "F32", "shape": [1], "data_offsets": [0, 4], **values}


DEEP = b'{"__metadata__":' + 20_000 * b"[" + 20_000 * b"]" + b"}"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "cut off"),
        (b"1234567", "cut off"),
        (DATA[:-1], "bytes"),
        (DATA + b"\0", "bytes"),
        (file_bytes(b"nonsense", b""), "not JSON"),
        (file_bytes(b"\xff\xfe{\0}\0", b""), "not JSON"),
        (file_bytes([], b""), "not a JSON object"),
        (file_bytes(DEEP, b""), "not JSON"),
        (file_bytes(b'{"a": 1, "a": 2}', b""), "given twice"),
        (file_bytes(b'{"a": NaN}', b""), "not a finite number"),
        (file_bytes(b'{"a": 1e999}', b""), "not a finite number"),
        (file_bytes({"__metadata__": {"emrld": 1}}, b""), "texts alone"),
        (file_bytes({"__metadata__": {"format": "pt"}}, b""), "'emrld' and no more"),
        (file_bytes({"__metadata__": {"emrld": "{"}}, b""), "not JSON"),
        (file_bytes({"__metadata__": {"emrld": "[]"}}, b""), "not a JSON object"),
        (file_bytes({"a": entry()}, b"1234"), "'emrld' and no more"),
        (file_bytes({"a": 5}, b""), "dtype, shape and data_offsets of 'a'"),
        (file_bytes({"a": entry(dtype="F64")}, b"1234"), "only 'F32'"),
        (file_bytes({"a": entry(shape=[2])}, b"1234"), "the bytes of its shape"),
        (file_bytes({"a": entry(shape=[-1])}, b"1234"), "whole numbers"),
        (file_bytes({"a": entry(shape=[True])}, b"1234"), "whole numbers"),
        (file_bytes({"a": entry(shape=[1.0])}, b"1234"), "whole numbers"),
        (file_bytes({"a": entry(shape=[1] * 100)}, b"1234"), "whole numbers"),
        (file_bytes({"a": entry(data_offsets=[0])}, b"1234"), "whole numbers"),
        (file_bytes({"a": entry(data_offsets=[4, 0])}, b"1234"), "the bytes of its shape"),
        (file_bytes({"a": entry(data_offsets=[4, 8])}, b"12345678"), "does not begin"),
        (file_bytes({"a": entry(), "b": entry()}, b"1234"), "does not begin"),
        (file_bytes({"a": entry()}, b"12345678"), "4 bytes, but 8"),
    ],
)
def test_what_is_no_whole_file_is_refused(data: bytes, words: str) -> None:
    assert_refused(data, words)


@pytest.mark.parametrize(
    "data",
    [
        (2**63).to_bytes(8, "little") + b"{}",
        b"\xff" * 8 + b"{}",
        (2**40).to_bytes(8, "little") + DATA[8:],
        file_bytes({"a": entry(shape=[2**40, 2**20], data_offsets=[0, 2**62])}, b""),
        file_bytes({"a": entry(shape=[10**300] * 8)}, b"1234"),
        file_bytes({"a": entry(shape=[2**62, 0], data_offsets=[0, 0])}, b""),
    ],
)
def test_what_is_only_claimed_takes_no_memory(data: bytes) -> None:
    tracemalloc.start()
    try:
        assert_refused(data)
        assert tracemalloc.get_traced_memory()[1] < 2**17
    finally:
        tracemalloc.stop()


def test_large_headers_and_large_files_are_not_read(tmp_path: Path) -> None:
    assert_refused(file_bytes(b" " * (MAX_HEADER + 1), b""), "header")
    large = tmp_path / "large.safetensors"
    with large.open("wb") as file:
        file.truncate(2**34)  # a hole, which takes no disk
    tracemalloc.start()
    try:
        with pytest.raises(BridgeError, match="at most"):
            bundles.read(large)
        assert tracemalloc.get_traced_memory()[1] < 2**17
    finally:
        tracemalloc.stop()


def outcome(data: bytes) -> str:
    """The hash of a file's content, or a word if it is refused; any other error is one."""
    try:
        return bundles.decode(data).content_sha256
    except BridgeError:
        return "refused"


def flipped(at: int, generator: np.random.Generator) -> bytes:
    return DATA[:at] + bytes([DATA[at] ^ int(generator.integers(1, 256))]) + DATA[at + 1 :]


def removed(at: int, generator: np.random.Generator) -> bytes:
    return DATA[:at] + DATA[at + int(generator.integers(1, 20)) :]


def inserted(at: int, generator: np.random.Generator) -> bytes:
    return DATA[:at] + generator.bytes(int(generator.integers(1, 20))) + DATA[at:]


@pytest.mark.parametrize("damage", [flipped, removed, inserted, lambda at, _: DATA[:at]])
def test_any_damage_is_refused_or_changes_nothing(
    damage: Callable[[int, np.random.Generator], bytes],
) -> None:
    generator = np.random.default_rng(0)
    outcomes = [outcome(damage(at, generator)) for at in range(len(DATA))]

    assert set(outcomes) <= {"refused", WHOLE.content_sha256}
    assert outcomes.count("refused") > 0.99 * len(DATA)


@pytest.mark.parametrize("kind", ["missing", "folder", "pipe"])
def test_what_is_no_file_is_told(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    {"missing": lambda path: None, "folder": os.mkdir, "pipe": os.mkfifo}[kind](path)

    words = "is a folder; .* emrld_jax.export run=" if kind == "folder" else "there is no such file"
    with pytest.raises(BridgeError, match=rf"policy\.safetensors:? {words}"):
        bundles.read(path)


def test_a_refusal_names_the_file(saved: Path) -> None:
    saved.write_bytes(DATA[:100])

    with pytest.raises(BridgeError, match=rf"{saved} is refused: it is cut off"):
        bundles.read(saved)


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_write_that_fails_leaves_what_was_there(
    saved: Path, broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr(os, broken, fail)
    with pytest.raises(OSError, match="disk is full"):
        bundles.write(saved, replace(WHOLE, seed=8))

    assert saved.read_bytes() == DATA
    assert list(saved.parent.iterdir()) == [saved]


@pytest.mark.parametrize("value", [np.float32(1), float("nan"), {1, 2}])
def test_what_json_cannot_say_is_not_written(saved: Path, value: Any) -> None:
    with pytest.raises(BridgeError, match="JSON"):
        bundles.write(saved, replace(WHOLE, provenance={"x": value}))

    assert saved.read_bytes() == DATA
