"""What `bridges.run` does: collect, adapt, execute."""

from __future__ import annotations

import time
from pathlib import Path
from types import ModuleType

import numpy as np

from bridges import bags, bundle, kept, people
from bridges.bundle import Bundle
from bridges.driving import Drive, actor
from bridges.episodes import Episode
from bridges.kept import ADAPTED, EXECUTION
from bridges.messages import BridgeError
from bridges.policy import Policy
from bridges.recording import Header, Recorder, header_of, read
from bridges.recording_checks import INDEX
from bridges.robot import TurtleBot3
from bridges.run_settings import RunConfig
from bridges.signals import Signals
from bridges.world import World, driving_settings, rules_of, world, zone_of

MOST_FAULTS = 3  # episodes in a row that may be broken off


class Session:
    """One command's work.

    Args:
        config: its settings.
        first: the bundle that they name.
        signals: that end the work.
        ask: puts a question to a person, and returns when they let it go on.

    Attributes:
        out: the folder for all that it writes.
        recorded: it has added an episode to a recording.

    Raises:
        BridgeError: the bundle drives no TurtleBot3, or settings do not go together.
    """

    def __init__(
        self,
        config: RunConfig,
        first: Bundle,
        signals: Signals,
        ask: people.Ask = people.ask,
    ) -> None:
        self._config, self._first, self._signals, self._ask = config, first, signals, ask
        self._zone = zone_of(first)
        self._rules = rules_of(config, first)
        self._confirmed = config.yes or config.dry_run or config.robot == "memory"
        self._asks = config.reset == "ask" and config.robot != "memory" and not config.dry_run
        self._driven = False  # since it was last known to be at its start
        self._world: World | None = None
        self.out = kept.folder_of(config)
        self.recorded = False

    def collect(self, driver: Bundle) -> None:
        """Drives a bundle's policy with its noise until there are enough whole episodes."""
        if driver.stage.adapted:
            raise BridgeError("the bundle is adapted already, so it collects nothing: mode=execute")
        name = f"recording_{driver.stage.recordings}"
        if self._missing(driver, name, noise=True):
            kept.check_not_used(self.out, driver)
        self._drive(driver, name, noise=True)

    def execute(self, driver: Bundle) -> None:
        """Drives a bundle's policy, adapted if it was, and as a rule without noise."""
        given, driver = driver, kept.adapted_of(self.out, driver)
        if driver is not given:
            print(f"{self.out / ADAPTED} is driven: it was adapted from the bundle that is given")
        if not driver.stage.adapted:
            print("note: the bundle is not adapted; mode=collect and mode=adapt would do that")
        self._drive(driver, EXECUTION, noise=not self._config.deterministic)

    def adapt(self, driver: Bundle) -> Bundle:
        """Adapts a bundle to what was recorded, and writes the bundle that this makes."""
        if not self._config.recordings and (before := kept.made_of(self.out, driver)):
            print(f"{kept.path_of(self.out, before)}: is adapted to the recording already")
            return before
        with self._signals.postponed("the adaptation"):
            return self._adapt(driver)

    def _adapt(self, driver: Bundle) -> Bundle:
        folders = [Path(text) for text in self._config.recordings]
        if not folders:
            folders = [self.out / f"recording_{k}" for k in range(driver.stage.recordings + 1)]
            if missing := [str(folder) for folder in folders if not folder.exists()]:
                raise BridgeError(
                    f"there is nothing to adapt to: {', '.join(missing)} is missing; mode=collect "
                    "drives the episodes (with the same out=), or recordings=[FOLDER] names them"
                )
        adapting = _adapting()
        recordings = [read(folder) for folder in folders]
        began = time.perf_counter()
        made: Bundle = adapting.adapted(driver, recordings)
        seconds = time.perf_counter() - began
        path = kept.path_of(self.out, made)
        bundle.write(path, made)
        episodes = sum(episode.whole for episode in recordings[-1].episodes)
        more = "" if made.stage.adapted else "; another inner step collects: drive this bundle next"
        print(f"adapted to {episodes} episodes in {seconds:.1f} s: {path}{more}", flush=True)
        return made

    def everything(self) -> Bundle:
        """Collects, adapts and executes; what is there already is not done again."""
        if self._config.dry_run:
            raise BridgeError("dry_run has nothing to adapt from: mode=collect or mode=execute")
        kept.check_execution(self.out, self._first)
        driver = self._first
        while not driver.stage.adapted:
            if kept.made_of(self.out, driver) is None:
                _adapting()  # whoever lacks JAX learns so before the robot is driven
            self.collect(driver)
            driver = self.adapt(driver)
        self.execute(driver)
        return driver

    def _drive(self, driver: Bundle, name: str, *, noise: bool) -> None:
        """Drives until the recording of this name has enough whole episodes."""
        bags.rosbags()  # whoever lacks it learns so before the robot is looked for
        if not self._missing(driver, name, noise=noise):
            print(f"{self.out / name}: {self._config.episodes} whole episodes are there already")
            return
        self._signals.check()
        self._world = self._world or world(self._config)
        with TurtleBot3(self._world.link, self._world.clock, self._rules) as robot:
            header = self._header(driver, noise, robot.command_type)
            recorder = Recorder(self.out / name, header)
            virtual = self._config.robot == "memory"
            progress = people.Progress(
                name, self._config.episodes, self._zone, driver.control_period, virtual
            )
            if not virtual:
                print(f"connected to the robot, which takes {robot.command_type}", flush=True)
            faults = 0
            while recorder.whole < self._config.episodes:
                episode = self._one(robot, self._world, driver, recorder, progress, noise)
                faults = 0 if episode.whole else faults + 1
                if faults == MOST_FAULTS:
                    raise BridgeError(
                        f"{faults} episodes in a row were broken off, the last one: "
                        f"{episode.ending}, {episode.detail}"
                    )

    def _one(
        self,
        robot: TurtleBot3,
        world: World,
        driver: Bundle,
        recorder: Recorder,
        progress: people.Progress,
        noise: bool,
    ) -> Episode:
        """Drives an episode and writes it down."""
        self._put_back(robot)
        progress.begin(recorder.whole)
        # an episode's own, so that one that goes on later has the noise it would have had
        seeds = [self._config.seed, driver.stage.recordings, len(recorder.episodes)]
        act = actor(Policy(driver), np.random.default_rng(seeds) if noise else None)
        drive = Drive(robot, act, self._zone, world.clock, driver.control_period)
        with self._signals.deferred():
            self._driven = True
            episode = drive.run(self._signals.reason, progress.show)
            recorder.add(episode)
            self.recorded = True
            progress.end(episode)
            if noise and not self._config.dry_run and people.stood_still(episode):
                print(
                    "note: the robot stood still in this episode; if it does in all of them, "
                    "adaptation learns from the demonstration alone",
                    flush=True,
                )
        return episode

    def _put_back(self, robot: TurtleBot3) -> None:
        """Brings the robot to its start, and asks whether it may move."""
        config = self._config
        if not self._confirmed:
            self._ask(people.confirm_motion(self._first, self._zone))
            self._confirmed = True
        elif self._asks and self._driven:
            self._ask("Put the robot back to its start, heading as it did.")
        elif self._asks and any(self.out.glob(f"*/{INDEX}")):  # yes=true, and not the first command
            print(
                f"note: {self.out} is gone on with, and --yes asks nobody: this episode, and its "
                "arena, begin wherever the robot stands now",
                flush=True,
            )
        if (config.reset == "service" or config.robot == "memory") and not config.dry_run:
            robot.reset()

    def _header(self, driver: Bundle, noise: bool, command_type: str) -> Header:
        """Of what this command drives."""
        return header_of(
            driver,
            noise=noise,
            dry_run=self._config.dry_run,
            command_type=command_type,
            driving=driving_settings(self._config),
        )

    def _missing(self, driver: Bundle, name: str, *, noise: bool) -> int:
        """How many whole episodes a recording lacks; refused if it was driven otherwise."""
        header = self._header(driver, noise, command_type="")
        return max(0, self._config.episodes - kept.whole(self.out / name, header))


def _adapting() -> ModuleType:
    try:
        # only here: all but this does without JAX
        from bridges import adapting  # noqa: PLC0415
    except ImportError as error:
        raise BridgeError(
            f"adapting needs JAX and what else emrld-jax depends on ({error}); copy the folder to "
            "a machine that has it, run mode=adapt there, and bring adapted.safetensors back (here "
            "mode=collect drives the episodes, mode=execute the adapted bundle)"
        ) from error
    return adapting
