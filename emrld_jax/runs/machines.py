"""The devices and processes that train together, and what processes agree on."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace

import jax
import numpy as np
from jax.experimental import multihost_utils

from emrld_jax.runs.checkpoints import Progressed
from emrld_jax.runs.config import ConfigError, TrainConfig
from emrld_jax.runs.provenance import software
from emrld_jax.runs.rendezvous import meet
from envs_jax.threads import at_least

EVALUATION_S = 24 * 3600  # that other processes wait for the first one at the end


def join(config: TrainConfig) -> list[jax.Device]:
    """Meets the other processes, if there are any; the devices that share the work.

    It has to come before anything else that uses JAX.

    Raises:
        ConfigError: there are not as many devices, or the processes did not meet in time.
    """
    split_cpu(1 if config.devices == "all" else int(config.devices))
    if config.distributed.num_processes > 1:
        _meet(config)
    if config.devices == "all":
        return jax.devices()
    wanted, there = int(config.devices), jax.local_device_count()
    if wanted > there:
        kind = jax.local_devices()[0].device_kind
        raise ConfigError(f"devices={wanted} is not allowed: there are {there} ({kind})")
    of_process = [[d for d in jax.devices() if d.process_index == p] for p in _processes()]
    return [device for own in of_process for device in own[:wanted]]


class ProcessLostError(RuntimeError):
    """Another process of this training has ended or cannot be reached any more."""


@contextmanager
def losses_told() -> Iterator[None]:
    """Raises ProcessLostError for what JAX raises when processes cannot talk to each other.

    Which that is depends on the operation that meets the loss; the transport's name is in all.
    """
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        text = str(error)[:200]
        if jax.process_count() > 1 and any(name in text for name in ("Gloo", "NCCL", "UNAVAIL")):
            raise ProcessLostError(
                f"another process has ended, or cannot be reached any more ({text}); what was "
                "saved can be continued, also with fewer processes"
            ) from error
        raise


def is_first() -> bool:
    """Whether this process is the one that writes files."""
    return jax.process_index() == 0


@contextmanager
def refusals_told() -> Iterator[None]:
    """In the first process: the others hear of it if it refuses to begin, and end too."""
    try:
        yield
    except Exception:
        largest(1)
        raise
    largest(0)


def hear_of_refusals() -> None:
    """In the other processes: waits for the first one to begin.

    Raises:
        ConfigError: it does not.
    """
    with losses_told():
        if largest(0):
            raise ConfigError("process 0 does not begin; its message tells why")


def from_first(runs: Sequence[Progressed]) -> list[Progressed]:
    """Where the first process says that the runs stand; others give values of the same shapes.

    Environment steps stay the process's own: only the first one writes them down.
    """
    if jax.process_count() == 1:
        return list(runs)
    with losses_told():
        told = multihost_utils.broadcast_one_to_all([run._replace(env_steps=0) for run in runs])
    return [
        Progressed(new.state, new.key, int(new.iteration), own.env_steps)
        for own, new in zip(runs, told, strict=True)
    ]


def largest(number: int) -> int:
    """The largest of the processes' numbers; each learns it at the same time."""
    if jax.process_count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.array(number))))


def _processes() -> range:
    return range(jax.process_count())


def split_cpu(parts: int) -> None:
    """Lets JAX see a CPU as so many devices, if it is what JAX computes on.

    It has no effect once JAX has been used, or where XLA_FLAGS says how many devices there are.
    """
    forced = re.search(
        r"xla_force_host_platform_device_count=(\d+)", os.environ.get("XLA_FLAGS", "")
    )
    parts = int(forced.group(1)) if forced else parts
    at_least(2 * parts)  # a device that waits for another one blocks a thread
    if parts > 1 and not forced:
        with suppress(RuntimeError):  # somebody has used JAX before: who counts devices will see
            jax.config.update("jax_num_cpu_devices", parts)


def _meet(config: TrainConfig) -> None:
    settings = config.distributed
    same = replace(config, distributed=replace(settings, process_id=0))
    meet(settings, json.dumps([asdict(same), software()], sort_keys=True))
    jax.distributed.initialize(
        settings.coordinator,
        settings.num_processes,
        settings.process_id,
        initialization_timeout=settings.timeout,
        heartbeat_timeout_seconds=settings.timeout,
        shutdown_timeout_seconds=EVALUATION_S,
    )
