"""The Python examples of the documentation run as they stand (README's for fewer iterations)."""

from __future__ import annotations

from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).parents[1]


def example(page: str) -> str:
    """The first Python example of a page."""
    return (ROOT / page).read_text().split("```python\n")[1].split("```")[0]


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


def test_the_example_of_parts_without_configuration() -> None:
    names: dict = {}
    exec(example("docs/guides/python.md"), names)
    assert names["env"].horizon == 80
    assert names["train"].demos.mask.shape[0] == 24  # TwoWheeled's training tasks
    params = names["learner"].init(jax.random.key(0)).params
    assert params["params"]["layer_0"]["kernel"].shape == (3, 100)
