"""README's Python example runs as it stands, for fewer iterations."""

from __future__ import annotations

from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def test_the_example_of_the_readme(capsys: pytest.CaptureFixture[str]) -> None:
    example = README.read_text().split("```python\n")[1].split("```")[0]
    assert "range(40)" in example
    exec(example.replace("range(40)", "range(2)"), {})
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [int(number) for number, _ in printed] == [0, 1]
    assert all(0 < float(value) < 100 for _, value in printed)  # rewarded from the start
