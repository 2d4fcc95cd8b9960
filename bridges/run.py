"""Drives a robot with a trained policy, and adapts the policy to what it finds."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress

from bridges import bundle, people
from bridges.bundle import Bundle
from bridges.command_line import configured, run_command
from bridges.locking import locked
from bridges.messages import BridgeError
from bridges.modes import Session
from bridges.run_settings import RunConfig
from bridges.settings import SettingError
from bridges.signals import Interrupted, Signals
from bridges.telling import tell

EXAMPLES = (
    "bundle=policy.safetensors robot=dds episodes=5 out=robot/first",
    "bundle=policy.safetensors robot=memory residual_angular_velocity=-0.65",
    "bundle=policy.safetensors robot=dds mode=collect reset=service speed=10 --yes",
    "bundle=robot/first/adapted.safetensors mode=execute episodes=3 out=robot/first",
)


def main() -> int:
    """Drives as the command line says."""
    config = configured(
        "bridges.run",
        "Collect episodes on a robot, adapt the policy to them, execute the adapted policy.",
        EXAMPLES,
        RunConfig(),
        meant=_meant,
    )
    return 0 if config is None else run(config)


def run(config: RunConfig, ask: people.Ask = people.ask) -> int:
    """Drives as the settings say.

    Args:
        config: the settings.
        ask: puts a question to a person, and returns when they let it go on.

    Returns:
        The exit code.

    Raises:
        BridgeError: says what to mend.
    """
    if not config.bundle:
        raise SettingError("bundle=FILE is missing: a policy that emrld_jax.export wrote")
    driver = bundle.read(config.bundle)
    with Signals() as signals:
        session = Session(config, driver, signals, ask)
        try:
            with locked(session.out):
                _work(session, config.mode, driver)
            signals.check()
        except Interrupted as error:
            print(f"\nstopped by {error}; the same command goes on", file=sys.stderr, flush=True)
            return error.code
    return 0


def _work(session: Session, mode: str, driver: Bundle) -> None:
    """Does what the mode says, and tells what was driven, also if it ends in an error."""
    try:
        if mode == "all":
            session.everything()
        else:
            getattr(session, mode)(driver)
    except BaseException:
        if session.recorded:
            with suppress(BridgeError, OSError):  # the first error counts
                tell(session.out, driver)
        raise
    if mode != "adapt":
        tell(session.out, driver)


def _meant(arguments: Sequence[str]) -> list[str]:
    """`--yes` as a setting."""
    return ["yes=true" if argument == "--yes" else argument for argument in arguments]


if __name__ == "__main__":
    run_command(main)
