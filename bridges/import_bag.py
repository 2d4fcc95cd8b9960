"""Demonstrations out of a teleoperated drive: `python -m bridges.import_bag BAG --out X.npz`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bridges import bag_content, teleoperation
from bridges.bag_content import BagContent, without_injected
from bridges.command_line import configured, run_command
from bridges.settings import SettingError
from emrld_jax.fields import setting

ENVIRONMENTS = ("two_wheeled", "two_wheeled_drift")


@dataclass
class ImportBagConfig:
    """All settings of importing a bag."""

    bag: str | None = setting(None, "rosbag2 folder or file, sqlite3 or MCAP; required")
    out: str = setting("demos.npz", "file to write; --out FILE is the same")
    env: str = setting("two_wheeled", "what it demonstrates", choices=ENVIRONMENTS)
    goal: list[float] = setting(
        [], "two_wheeled's task: x (m) ahead and y (m) to the left; []: where the drive ended"
    )
    residual_angular_velocity: float | None = setting(
        None, "two_wheeled_drift's task: rad a control period that the robot turns by itself"
    )
    quality: str = setting("teleoperated", "label to store; suboptimal: weighs the data less")
    odometry: str = setting("/odom", "topic of odometry")
    commands: str = setting("/cmd_vel", "topic of commands; if there are none: odometry's speeds")


def main() -> int:
    """Imports a bag as the command line says."""
    config = configured(
        "bridges.import_bag",
        "Turn a teleoperated recording into demonstrations.",
        ("BAG --out demos.npz env=two_wheeled", "bag=drive env=two_wheeled goal=[2,0]"),
        ImportBagConfig(),
        meant=_meant,
    )
    if config is None:
        return 0
    if not config.bag:
        raise SettingError("bag=PATH is missing: the recording to import")
    out = Path(config.out)
    if out.suffix != ".npz":
        raise SettingError(f"out={out} must end in .npz")
    if out.exists():
        raise SettingError(f"{out} exists; choose another file with out=PATH")
    content = bag_content.read(Path(config.bag), config.odometry, config.commands)
    # only now: whatever is wrong with the bag is told at once
    from bridges import demonstrations  # noqa: PLC0415

    env = demonstrations.environment(config.env)
    content, injected = _as_acted(config.env, content)
    drive = teleoperation.resampled(content, env.dt)
    task, told = demonstrations.task(env, drive, config.goal, config.residual_angular_velocity)
    report = demonstrations.write(out, env, task, drive, config.quality, Path(config.bag))
    for line in (*drive.notes, *injected, told, *report, f"wrote {out}"):
        print(line)
    return 0


def _as_acted(env: str, content: BagContent) -> tuple[BagContent, list[str]]:
    """The content with the actions that the environment would take, and a note about them."""
    if not content.injected:
        return content, []
    told = f"the bridge added {content.injected:g} rad/s to what its policy asked for"
    if env == "two_wheeled_drift":
        return without_injected(content), [f"{told}: taken off the commands"]
    return content, [f"{told}: in {env} nothing turns by itself, so actions are what was sent"]


def _meant(arguments: Sequence[str]) -> list[str]:
    """`BAG --out FILE` as settings."""
    rest, meant = list(arguments), []
    while rest:
        argument = rest.pop(0)
        if argument.startswith("--out"):
            value = argument.partition("=")[2] or (rest.pop(0) if rest else "")
            meant.append(f"out={value}")
        elif "=" not in argument and not argument.startswith("-"):
            meant.append(f"bag={argument}")
        else:
            meant.append(argument)
    return meant


if __name__ == "__main__":
    run_command(main)
