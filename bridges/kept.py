"""What is in a command's folder already, and whether the command may go on with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bridges import bundle, recording
from bridges.bundle import Bundle
from bridges.messages import BridgeError
from bridges.recording import Header, whole_episodes
from bridges.recording_checks import INDEX
from bridges.run_settings import RunConfig
from bridges.stages import is_after_step, steps

EXECUTION = "execution"  # the folder of the adapted policy's episodes
ADAPTED = "adapted.safetensors"


def folder_of(config: RunConfig) -> Path:
    """Where a command writes: as it says, or by the bundle's name; what cannot be mixed, apart."""
    where = "simulated" if config.robot == "memory" else "robot"
    where = "dry_run" if config.dry_run else where
    return Path(config.out or f"{where}/{Path(str(config.bundle)).stem}")


def path_of(out: Path, made: Bundle) -> Path:
    """Where a bundle belongs that adaptation has made."""
    name = ADAPTED if made.stage.adapted else f"policy_{made.stage.recordings}.safetensors"
    return out / name


def whole(folder: Path, header: Header) -> int:
    """How many whole episodes a recording has, which may not be there yet.

    Args:
        folder: of the recording.
        header: of what would be driven; its type of command is not looked at, for only a robot
            that is connected tells it.

    Raises:
        RecordingError: what is there was driven otherwise, or is damaged.
    """
    if not (folder / INDEX).is_file():
        return 0
    begun = recording.read(folder)
    recording.check_same(
        folder, begun.header, replace(header, command_type=begun.header.command_type)
    )
    return len(whole_episodes(begun))


def made_of(out: Path, driver: Bundle) -> Bundle | None:
    """What adaptation has made of this bundle and its recording already."""
    number = driver.stage.recordings
    folder = out / f"recording_{number}"
    if not (folder / INDEX).is_file():
        return None
    for path in (out / ADAPTED, out / f"policy_{number + 1}.safetensors"):
        if path.is_file():
            made = bundle.read(path)
            if is_after_step(made, driver, recording.read(folder)):
                return made
    return None


def adapted_of(out: Path, driver: Bundle) -> Bundle:
    """The adapted bundle that was made of this one and its recordings; itself, if there is none.

    Raises:
        BridgeError: one was made of it, but of other recordings than are there.
    """
    made: Bundle | None = driver
    while made is not None and not made.stage.adapted:
        made = made_of(out, made)
    if made is not None:
        return made
    if (path := _learned_from(out, driver)) is not None:
        raise BridgeError(
            f"{path} was adapted from this bundle, but not to the recordings that are in {out}: "
            f"bundle={path} drives it, another out= drives the bundle that is not adapted"
        )
    return driver


def check_not_used(out: Path, driver: Bundle) -> None:
    """Refuses to add episodes to a recording that adaptation has learned from.

    Raises:
        BridgeError: it has.
    """
    if (path := _learned_from(out, driver)) is not None:
        raise BridgeError(
            f"{path} has learned from {out / f'recording_{driver.stage.recordings}'} already, so "
            "no more episodes are added to that: choose another folder with out=, or drive more "
            "episodes of the adapted policy with mode=execute"
        )


def check_execution(out: Path, first: Bundle) -> None:
    """Refuses a folder whose execution is of a bundle that is not adapted from the first one.

    Raises:
        BridgeError: it is.
    """
    if first.stage.adapted or not (out / EXECUTION / INDEX).is_file():
        return
    driven = recording.read(out / EXECUTION).header.bundle
    path = out / ADAPTED
    if not path.is_file() or bundle.read(path).content_sha256 != driven:
        raise BridgeError(
            f"{out / EXECUTION} is a recording of another bundle than the one that adaptation "
            "makes: choose another folder with out="
        )


def _learned_from(out: Path, driver: Bundle) -> Path | None:
    """The file there that an inner step has made of this bundle, by whatever recording."""
    for path in (out / ADAPTED, out / f"policy_{driver.stage.recordings + 1}.safetensors"):
        if path.is_file():
            learned = {step["bundle"] for step in steps(bundle.read(path))}
            if driver.content_sha256 in learned:
                return path
    return None
