"""The Python examples of the documentation run as they stand (README's for fewer iterations)."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import pytest

from emrld_jax import algorithms

ROOT = Path(__file__).parents[1]


def example(page: str, number: int = 1) -> str:
    """A Python example of a page, counted from 1."""
    return (ROOT / page).read_text().split("```python\n")[number].split("```")[0]


def test_the_example_of_the_readme(capsys: pytest.CaptureFixture[str]) -> None:
    code = example("README.md")
    assert "range(40)" in code
    exec(code.replace("range(40)", "range(2)"), {})
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [int(number) for number, _ in printed] == [0, 1]
    assert all(0 < float(value) < 100 for _, value in printed)  # rewarded from the start


def test_the_example_of_the_environments(capsys: pytest.CaptureFixture[str]) -> None:
    exec(example("docs/environments.md"), {})
    # full speed ahead for half a second; the goal is 2 m away
    assert capsys.readouterr().out.split() == ["[0.11", "0.", "0.", "]", "0.0", "0.0"]


def test_the_example_of_the_simulator(capsys: pytest.CaptureFixture[str]) -> None:
    exec(example("docs/bridge/simulator.md"), {})
    # 2 s at 0.15 m/s, held straight against the drift
    x = re.search(r"stamp=2.0, .* x=([\d.]+)", capsys.readouterr().out)
    assert x
    assert float(x[1]) == pytest.approx(0.3, abs=0.01)


def test_the_example_of_the_robot(capsys: pytest.CaptureFixture[str]) -> None:
    exec(example("docs/bridge/robot.md"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert all("linear=0.2" in line for line in lines[1:])
    # three periods of 0.2 m/s and 0.5 rad/s: an arc of 0.4 m radius, less the way to full speed
    x, y, theta = (float(number) for number in lines[3].split("[")[1].split("]")[0].split())
    assert theta == pytest.approx(0.75, abs=0.03)
    assert (x, y) == pytest.approx((0.4 * 0.68, 0.4 * 0.27), abs=0.02)


def test_the_example_of_parts_without_configuration() -> None:
    names: dict = {}
    exec(example("docs/guides/python.md"), names)
    assert names["env"].horizon == 80
    assert names["train"].demos.mask.shape[0] == 24  # TwoWheeled's training tasks
    params = names["learner"].init(jax.random.key(0)).params
    assert params["params"]["layer_0"]["kernel"].shape == (3, 100)


@pytest.mark.parametrize(
    ("number", "words"),
    [
        # half a second ahead, and a turn; the goal of task 3 is at 22.5 degrees, 2 m away
        (1, ["[0.11", "0.", "0.25", "[1.84775907", "0.76536686"]),
        (2, ["(12,", "2)", "(12,", "2)"]),
        (3, ["True"]),  # it gets there
    ],
)
def test_the_examples_of_gymnasium(
    number: int, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    exec(example("docs/bridge/gymnasium.md", number), {})
    told = capsys.readouterr().out.replace("]", " ").split()
    for word, expected in zip(told, words, strict=False):
        if "." in expected:
            assert float(word.strip("[")) == pytest.approx(float(expected.strip("[")), abs=1e-6)
        else:
            assert word == expected


@pytest.mark.parametrize("page", ["docs/guides/algorithm.md", "docs/concepts.md"])
def test_tables_of_algorithms_are_complete(page: str) -> None:
    rows = [line for line in (ROOT / page).read_text().splitlines() if line.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row.split("|")[1])}
    assert set(algorithms.names()) <= named


def test_every_algorithm_is_in_the_reference() -> None:
    page = (ROOT / "docs/reference/algorithms.md").read_text().splitlines()
    assert {f"::: emrld_jax.algorithms.{name}" for name in algorithms.names()} <= set(page)


@pytest.mark.parametrize("name", algorithms.names())
def test_every_algorithm_has_a_page_with_its_file_and_its_source(name: str) -> None:
    page = (ROOT / f"docs/algorithms/{name}.md").read_text()
    assert f'--8<-- "emrld_jax/algorithms/{name}.py"' in page
    assert "Source: " in page
    assert f"{name}.md" in (ROOT / "docs/algorithms/index.md").read_text()
