"""Arguments of the bridge's commands."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field

import pytest

from bridges.settings import SettingError, parse
from bridges.transports.base import LinkSettings
from emrld_jax.fields import setting


@dataclass
class Example:
    """Settings of every type."""

    bundle: str | None = setting(None, "a file")
    episodes: int = setting(5, "how many", at_least=1)
    watchdog: float = setting(0.5, "s", above=0)
    dry_run: bool = setting(False, "publish nothing")
    goal: list[float] = setting([2.0, 1.0], "m")
    link: LinkSettings = field(default_factory=LinkSettings)


def test_every_type_is_read() -> None:
    config = parse(
        [
            *("bundle=a=b, [c].safetensors", "episodes=7", "watchdog=2.5e-1", "dry_run=true"),
            *("goal=[1,-2.5]", "link.peers=[10.0.0.2,robot.local]", "link.domain_id=30"),
        ],
        Example(),
    )

    link = LinkSettings(domain_id=30, peers=["10.0.0.2", "robot.local"])
    assert config == Example("a=b, [c].safetensors", 7, 0.25, True, [1.0, -2.5], link)


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("--episodes", "not of the form setting=value"),
        ("episode=3", "did you mean 'episodes'"),
        ("episodes=0", "episodes=0 is not allowed: it must be at least 1"),
        ("episodes=2.5", "a whole number"),
        ("watchdog=nan", "finite"),
        ("watchdog=soon", "a number, above 0"),
        ("dry_run=1", "true or false"),
        ("goal=2", "a list of numbers"),
        ("goal=[a,b]", "a list of numbers"),
        ("goal=[1", "a list of numbers"),
        ("link.command_type=twists", "one of auto, twist, twist_stamped"),
        ("link.domain_id=102", "at most 101"),
    ],
)
def test_what_is_wrong_is_told(argument: str, words: str) -> None:
    with pytest.raises(SettingError) as error:
        parse([argument], Example())

    assert words in str(error.value)


def test_a_setting_is_given_once() -> None:
    with pytest.raises(SettingError, match="given twice"):
        parse(["episodes=1", "episodes=2"], Example())


def test_settings_need_no_jax() -> None:
    code = "import sys, bridges.settings, bridges.clock; sys.exit('jax' in sys.modules)"

    done = subprocess.run([sys.executable, "-c", code], check=False, timeout=60)
    assert done.returncode == 0
