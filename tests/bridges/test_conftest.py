"""What tests wait for has an end."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.bridges import conftest


def test_who_says_nothing_is_not_waited_for_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conftest, "LIMIT", 0.2)
    mute = [sys.executable, "-c", "import time; time.sleep(60)"]
    process = subprocess.Popen(mute, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with conftest.limited(process):
        assert process.stdout.readline() == ""
    assert process.wait(10) != 0
    process.stdout.close()
