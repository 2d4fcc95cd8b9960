"""A TurtleBot3 on which one acts through Gymnasium: real, or simulated anywhere."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from bridges import people
from bridges.episodes import ARENA
from bridges.gymnasium.checks import METADATA, check_mode, check_options, checked_action
from bridges.gymnasium.drawing import draw_plane
from bridges.gymnasium.ground import action_space, ground, observation_space, run_config
from bridges.messages import STOP, Command
from bridges.robot import TurtleBot3
from bridges.safety import Fault, RobotFault
from bridges.task import distance_to_goal, outcome
from bridges.world import rules_of, world, zone_of

LATE = 0.05  # s after which an action has missed its moment


class TurtleBot3Env(gymnasium.Env[np.ndarray, np.ndarray]):
    """A robot that drives with physical actions, guarded as `bridges.run` guards it.

    A step sends linear (m/s) and angular (rad/s) velocity for one control period, and returns what
    was observed at its end: x (m), y (m) and theta (rad), since the episode began. An episode is
    `terminated` by success or by leaving the arena. It is `truncated` by the horizon, or by a fault
    (info["fault"] says which), where the robot has been stopped.

    Between two steps the robot drives on with its last command. If no step comes within `watchdog`
    seconds (real ones; never in virtual time) it is stopped; the next step goes on.

    Args:
        robot: "auto", "rclpy", "dds", or "memory", a simulated one in this process.
        bundle: a file of `emrld_jax.export`, whose goal, limits and control period count; None: a
            goal by the rules of `two_wheeled_drift`.
        goal: x and y, m from where an episode begins, 2 and 1 unless said; not with a bundle.
        reward: "sparse", unless said, or "dense"; not with a bundle.
        horizon: steps of an episode, 100 unless said; not with a bundle.
        render_mode: "rgb_array" or None.
        **settings: of `bridges.run`: reset, yes, dry_run, residual_angular_velocity, watchdog,
            max_linear, max_angular, linear_acceleration, angular_acceleration, room, origin, speed;
            and as dictionaries link and sim.

    Raises:
        ValueError: an unknown setting, or an impossible value.
        BridgeError: the bundle cannot be read, or settings do not go together.
    """

    metadata = METADATA

    def __init__(
        self,
        *,
        robot: str = "auto",
        bundle: str | None = None,
        goal: Sequence[float] | None = None,
        reward: str | None = None,
        horizon: int | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        check_mode(render_mode)
        self.render_mode = render_mode
        self._config = run_config(robot, settings)
        self._ground = ground(bundle, goal, reward, horizon)
        self._zone = zone_of(self._ground)
        self._rules = rules_of(self._config, self._ground)
        self.action_space = action_space(self._ground)
        self.observation_space = observation_space(self._ground, self._zone)
        self._confirmed = self._config.yes or self._config.dry_run or robot == "memory"
        self._driven = self._going = False
        self._close: weakref.finalize | None = None  # while it is connected
        self._path: list[np.ndarray] = []  # poses of this episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Has the robot put back to its start, and begins an episode where it then is.

        The first time it connects, and asks whether the robot may move (unless `yes`). Putting back
        is asked of a person too, or of a simulator (`reset="service"`, and `robot="memory"`).

        Args:
            seed: a robot in memory begins anew, with noise of this seed; others do not care.
            options: none are known.

        Returns:
            The observation, and info as after a step.

        Raises:
            BridgeError: the robot cannot be reached, or does not tell where it is.
            RobotFault: it may not drive from where it is.
        """
        super().reset(seed=seed)
        check_options(options, ())
        if seed is not None and self._config.robot == "memory":
            self.close()
            noise = replace(self._config.sim, seed=int(self.np_random.integers(2**31)))
            self._config = replace(self._config, sim=noise)
        self._connect()
        with self._used():
            self._put_back()
            self._robot.begin()
            self._going, self._t = True, 0
            self._due: float | None = None
            obs = self._robot.get_observation()
            self._path = [obs.pose]
            return obs.pose.copy(), self._info(obs.age)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Drives for a control period.

        Returns:
            Observation, reward, terminated, truncated, and info: `task`; `success`; `distance` to
            the goal, m; `age`, s, of the odometry that was observed; `late`, s from the end of the
            period before to this action; `sent`, the velocities [2] that were sent first, within
            limits and rate limits; `fault`, why the robot was stopped, or nothing.

        Raises:
            ResetNeeded: no episode has begun, or it has ended.
            ValueError: the action has another shape, or is not finite.
        """
        if not self._going:
            raise ResetNeeded("there is no episode, or it has ended: reset() begins one")
        checked = checked_action(action, (2,))
        with self._used():
            self._robot.go_on()  # between two steps it may be left alone
            return self._step(checked)

    def render(self) -> Any:
        """A picture of the plane with the robot's path, [400, 400, 3] uint8.

        Raises:
            ResetNeeded: no episode has begun.
        """
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array' when it is made")
            return None
        if not self._path:
            raise ResetNeeded("there is nothing to render before reset()")
        return draw_plane(self._zone, np.stack(self._path))

    def close(self) -> None:
        """Stops the robot and disconnects; `reset` connects again."""
        self._going = False
        if self._close is not None:
            self._close()
            self._close = None

    def _connect(self) -> None:
        if self._close is not None:
            return
        link, self._clock = world(self._config)
        self._robot = TurtleBot3(link, self._clock, self._rules)
        self._robot.connect()
        # also when the program ends, or forgets the environment
        self._close = weakref.finalize(self, self._robot.disconnect)

    @contextmanager
    def _used(self) -> Iterator[None]:
        """While the robot is used; it stands still after an error, or an interruption."""
        try:
            yield
        except BaseException:
            self._going = False
            self._robot.stop()
            raise

    def _put_back(self) -> None:
        """Asks whether the robot may move, and brings it to its start."""
        simulated = self._config.robot == "memory" or self._config.reset == "service"
        if not self._confirmed:
            people.ask(people.confirm_motion(self._ground, self._zone))
            self._confirmed = True
        elif self._driven and not simulated and not self._config.dry_run:
            people.ask("Put the robot back to its start, heading as it did.")
        if simulated and not self._config.dry_run:
            self._robot.reset()

    def _step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        began = self._clock.now()
        late = 0.0 if self._due is None else max(0.0, began - self._due)
        sent = STOP
        fault: Fault | None = None
        try:
            self._driven = True
            sent = self._robot.send_action(action)
        except RobotFault as error:
            fault = error.fault
        else:
            start = began if self._due is None or late > LATE else self._due
            self._due = start + self._ground.control_period
            fault = self._robot.hold(self._due)
        if fault is not None and fault.reason != ARENA:
            return self._broken(fault, late, sent)
        obs = self._robot.get_observation()
        self._path.append(obs.pose)
        x, y = (float(value) for value in obs.pose[:2])
        result = outcome(self._zone, x, y, self._t)
        self._t += 1
        # a robot that was seen outside the arena may be back by now
        terminated = result.done or fault is not None
        truncated = not terminated and self._t >= self._zone.horizon
        if terminated or truncated:
            self._going = False
            self._robot.stop()
        info = self._info(obs.age, late, sent, success=result.success)
        return obs.pose.copy(), result.reward, terminated, truncated, info

    def _broken(
        self, fault: Fault, late: float, sent: Command = STOP
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """A step whose end is not known: the robot was stopped, and was last seen before it."""
        self._going = False
        age = self._robot.get_observation().age
        info = self._info(age, late, sent, fault=f"{fault.reason}: {fault.detail}")
        return self._path[-1].copy(), 0.0, False, True, info

    def _info(
        self,
        age: float,
        late: float = 0.0,
        sent: Command = STOP,
        *,
        success: bool = False,
        fault: str = "",
    ) -> dict[str, Any]:
        x, y = (float(value) for value in self._path[-1][:2])
        return {
            "task": {
                k: np.array(v) if isinstance(v, list) else v for k, v in self._ground.task.items()
            },
            "success": success,
            "distance": distance_to_goal(self._zone, x, y),
            "age": age,
            "late": late,
            "sent": np.array(sent, np.float32),
            "fault": fault,
        }
