"""One episode of a policy on a robot, at the policy's control period."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bridges.bundle import Zone
from bridges.clock import Clock
from bridges.episodes import ARENA, HORIZON, SUCCESS, Episode, Step
from bridges.messages import BridgeError
from bridges.policy import Policy
from bridges.robot import Observation, TurtleBot3
from bridges.safety import Fault, RobotFault
from bridges.task import outcome


class Act(NamedTuple):
    """What a policy does at an observation."""

    action: np.ndarray  # [2] float32, policy units
    physical: np.ndarray  # [2], m/s and rad/s, within the policy's bounds
    log_prob: float  # of the action, as the mean over its dimensions


Actor = Callable[[np.ndarray], Act]  # of an observation [3]
Watch = Callable[[Episode], None]  # of what is known of an episode after each step


def actor(policy: Policy, generator: np.random.Generator | None) -> Actor:
    """Acts with the policy's noise, or without a generator by its mean.

    In float32, as simulated episodes are kept: what is recorded is what was done. It refuses
    (BridgeError) observations and actions that are not finite.
    """

    def act(obs: np.ndarray) -> Act:
        chosen = policy.mean(obs) if generator is None else policy.sample(obs, generator)
        action = chosen.astype(np.float32)
        if not np.isfinite(action).all():
            raise BridgeError(f"the policy's action is not finite: {action} at {obs}")
        return Act(action, policy.to_physical(action), log_prob(policy, obs, action))

    return act


def log_prob(policy: Policy, obs: np.ndarray, action: np.ndarray) -> float:
    """Log-density of an action [A] at an observation [O], as `emrld_jax.policy.log_prob` has it.

    The mean over the action's dimensions.
    """
    z = (action - policy.mean(obs)) / policy.std
    return float(np.mean(-0.5 * z**2 - np.log(policy.std) - 0.5 * math.log(2 * math.pi)))


class Drive:
    """One episode.

    Args:
        robot: connected.
        act: what to do.
        zone: the task's rules.
        clock: the robot's.
        period: s a control step.
        late: s after which a command has missed its deadline.
    """

    def __init__(
        self,
        robot: TurtleBot3,
        act: Actor,
        zone: Zone,
        clock: Clock,
        period: float,
        late: float = 0.05,
    ) -> None:
        self._robot, self._act, self._zone = robot, act, zone
        self._clock, self._period, self._late = clock, period, late
        self._steps: list[Step] = []
        self._missed = 0
        self._last = np.zeros(3, np.float32)

    def run(
        self,
        interrupted: Callable[[], str | None] = lambda: None,
        watch: Watch = lambda episode: None,
    ) -> Episode:
        """Drives from where the robot is to the episode's end, where it stands still.

        Args:
            interrupted: asked at each tick of the robot; a text ends the episode.
            watch: told after each step.

        Returns:
            The episode; without steps if the robot may not be driven from where it is.

        Raises:
            BridgeError: there is no odometry.
        """
        self._began, self._began_wall = self._clock.now(), time.time_ns()
        try:
            self._robot.begin()
            self._began, self._began_wall = self._clock.now(), time.time_ns()
            end = self._to_the_end(interrupted, watch)
        except RobotFault as error:  # of the beginning
            end, self._last = error.fault, self._robot.get_observation().pose
        finally:
            self._robot.stop()
        return self._episode(end)

    def _to_the_end(self, interrupted: Callable[[], str | None], watch: Watch) -> Fault:
        moment, obs = self._began, self._robot.get_observation()
        for _ in range(self._zone.horizon):
            if reason := interrupted():  # before it moves: `hold` asks only after it has begun to
                return Fault("interrupted", reason)
            try:
                step = self._step(obs, moment)
            except RobotFault as error:
                return self._left() if error.fault.reason == ARENA else error.fault
            if step.latency > self._late:
                self._missed += 1
                moment = step.time  # each step lasts its period
            moment += self._period
            fault = self._robot.hold(moment, interrupted)
            obs = self._robot.get_observation()
            self._last = obs.pose
            if fault is not None and fault.reason != ARENA:
                return fault  # what the step would have led to is not known
            done = self._judged(step, obs, left=fault is not None)
            watch(self._episode(Fault("", "")))
            if done:
                return Fault(SUCCESS if self._steps[-1].success else ARENA, "")
        return Fault(HORIZON, "")

    def _left(self) -> Fault:
        """The arena was left after a step had been judged, before the next action: by that step."""
        self._last = self._robot.get_observation().pose
        if self._steps:
            self._steps[-1] = self._steps[-1]._replace(done=True)
        return Fault(ARENA, "")

    def _step(self, obs: Observation, due: float) -> Step:
        """Acts; what it leads to is not known yet."""
        act = self._act(obs.pose)
        command = self._robot.send_action(act.physical)
        sent = self._clock.now()
        age = self._robot.get_observation().age
        return Step(
            sent, obs.pose, act.action, command, act.log_prob, 0.0, False, False, age, sent - due
        )

    def _judged(self, step: Step, after: Observation, left: bool) -> bool:
        """Keeps a step with what it led to; whether that ends the episode."""
        x, y, _ = (float(value) for value in after.pose)
        reward, done, success = outcome(self._zone, x, y, len(self._steps))
        done = done or left  # a robot that was seen outside the arena may be back by now
        self._steps.append(step._replace(reward=reward, done=done, success=success))
        return done

    def _episode(self, end: Fault) -> Episode:
        return Episode(
            began=self._began,
            began_wall=self._began_wall,
            steps=tuple(self._steps),
            last_pose=self._last,
            ending=end.reason,
            detail=end.detail,
            missed=self._missed,
            odometry=tuple(self._robot.odometry),
            commands=tuple(self._robot.commands),
        )
