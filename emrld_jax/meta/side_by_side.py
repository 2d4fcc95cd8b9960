"""Learners side by side in one program, and its work spread over the devices of a mesh.

K learners differ in their parameters, keys and numeric settings. A mesh has two axes: its rows
share the learners, its columns the tasks. Devices of a row talk to each other in each mean over
tasks (a gradient, a Fisher-vector product, a step length that is tried); rows meet only at the
end of an iteration, when everybody gets the new states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import gcd
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from emrld_jax.meta.batching import map_each, max_over_devices
from emrld_jax.meta.learner import Gathered, Halves, MetaState, Sizes, bucket_sizes
from emrld_jax.meta.outer import Metrics
from emrld_jax.types import Demos, Experience, OuterDemos, Params, Task

LEARNERS, TASKS = "learners", "tasks"  # the axes of a mesh

Values = Mapping[str, Any]  # a number for each setting that learners differ in, or numbers [K]


def make_mesh(devices: Sequence[jax.Device], learners: int, tasks: int) -> Mesh:
    """A mesh of all these devices that divides the learners first, as they need not talk.

    Raises:
        ValueError: the work cannot be divided into equal parts; tells what can.
    """
    if (shape := _shape(len(devices), learners, tasks)) is None:
        possible = [n for n in range(1, 2 * len(devices)) if _shape(n, learners, tasks)]
        raise ValueError(
            f"{len(devices)} devices cannot share {learners} run(s) of {tasks} tasks in equal "
            f"parts; these numbers can: {', '.join(map(str, possible))}"
        )
    return Mesh(np.array(devices).reshape(shape), (LEARNERS, TASKS))


def _shape(devices: int, learners: int, tasks: int) -> tuple[int, int] | None:
    rows = gcd(devices, learners)
    return None if tasks % (devices // rows) else (rows, devices // rows)


def replicate(tree: Any, mesh: Mesh) -> Any:
    """Arrays that every process has, as arrays that every device of the mesh has."""
    return _place(tree, NamedSharding(mesh, P()))


def share_tasks(tree: Any, mesh: Mesh) -> Any:
    """Arrays with a leading [M] that every process has, spread over the mesh's columns."""
    return _place(tree, NamedSharding(mesh, P(TASKS)))


def _place(tree: Any, sharding: NamedSharding) -> Any:
    def place(leaf: Any) -> jax.Array:
        array = np.asarray(leaf)
        return jax.make_array_from_callback(array.shape, sharding, lambda part: array[part])

    return jax.tree.map(place, tree)


# (states [K], keys [K], values [K], tasks [M], demos [M], outer demos [M])
Arguments = tuple[MetaState, jax.Array, Values, Task, Demos, OuterDemos]


class SideBySide(NamedTuple):
    """K learners on a mesh."""

    update: Callable[[*Arguments], tuple[MetaState, Metrics]]  # one meta-iteration of each
    # the two programs that the same arguments lead to, to be looked at
    compiled: Callable[[*Arguments], list[jax.stages.Compiled]]


def side_by_side(halves_of: Callable[[Values], Halves], mesh: Mesh) -> SideBySide:
    """Compiled meta-iterations of K learners on a mesh.

    Results are on every device, so that any process can save them whatever becomes of others.

    Args:
        halves_of: the halves of a meta-iteration with these values, which may be traced.
        mesh: of `make_mesh`.
    """
    gather = jax.jit(partial(_gather, halves_of, mesh))
    improve = jax.jit(partial(_improve, halves_of, mesh), static_argnums=5)

    def update(
        states: MetaState,
        keys: jax.Array,
        values: Values,
        tasks: Task,
        demos: Demos,
        outer_demos: OuterDemos,
    ) -> tuple[MetaState, Metrics]:
        experience, needed, metrics = gather(states.params, keys, values, tasks, demos)
        sizes = bucket_sizes(experience, needed)
        states, outer = improve(states, values, experience, demos, outer_demos, sizes)
        return states, {**metrics, **outer}

    def compiled(
        states: MetaState,
        keys: jax.Array,
        values: Values,
        tasks: Task,
        demos: Demos,
        outer_demos: OuterDemos,
    ) -> list[jax.stages.Compiled]:
        first = gather.lower(states.params, keys, values, tasks, demos).compile()
        experience, needed, _ = first(states.params, keys, values, tasks, demos)
        sizes = bucket_sizes(experience, needed)
        second = improve.lower(states, values, experience, demos, outer_demos, sizes)
        return [first, second.compile()]

    return SideBySide(update, compiled)


def _gather(
    halves_of: Callable[[Values], Halves],
    mesh: Mesh,
    params: Params,
    keys: jax.Array,
    values: Values,
    tasks: Task,
    demos: Demos,
) -> Gathered:
    def own(params: Params, keys: jax.Array, values: Values, tasks: Task, demos: Demos) -> Gathered:
        def one(params: Params, keys: jax.Array, values: Values) -> Gathered:
            return halves_of(values).gather(params, keys, tasks, demos, TASKS)

        # at once, also on a CPU: a simulator that is called steps all learners in one call
        experience, needed, metrics = jax.vmap(one)(params, keys, values)
        most = jax.tree.map(jnp.max, needed)
        return Gathered(experience, max_over_devices(most, LEARNERS), metrics)

    task_keys = jax.vmap(lambda key: jax.random.split(key, demos.mask.shape[0]))(keys)
    sharded = jax.shard_map(
        own,
        mesh=mesh,
        in_specs=(P(LEARNERS), P(LEARNERS, TASKS), P(LEARNERS), P(TASKS), P(TASKS)),
        out_specs=Gathered(P(LEARNERS, TASKS), P(), P(LEARNERS)),  # type: ignore[arg-type]
        check_vma=False,  # derivatives are averaged by hand, Objective.average
    )
    gathered = sharded(params, task_keys, values, tasks, demos)
    return gathered._replace(metrics=_everywhere(gathered.metrics, mesh))


def _improve(
    halves_of: Callable[[Values], Halves],
    mesh: Mesh,
    states: MetaState,
    values: Values,
    experience: Experience,
    demos: Demos,
    outer_demos: OuterDemos,
    sizes: Sizes,
) -> tuple[MetaState, Metrics]:
    def own(
        states: MetaState,
        values: Values,
        experience: Experience,
        demos: Demos,
        outer_demos: OuterDemos,
    ) -> Any:
        def one(state: MetaState, values: Values, experience: Experience) -> Any:
            improve = halves_of(values).improve
            return improve(state, experience, demos, outer_demos, sizes, TASKS)

        return map_each(one, states, values, experience)

    sharded = jax.shard_map(
        own,
        mesh=mesh,
        in_specs=(P(LEARNERS), P(LEARNERS), P(LEARNERS, TASKS), P(TASKS), P(TASKS)),
        out_specs=P(LEARNERS),
        check_vma=False,
    )
    return _everywhere(sharded(states, values, experience, demos, outer_demos), mesh)


def _everywhere(tree: Any, mesh: Mesh) -> Any:
    """A tree with a leading [K], put on all devices; packed, so that it is one message."""
    _, unpack = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], tree))
    packed = jax.vmap(lambda own: ravel_pytree(own)[0])(tree)
    packed = jax.lax.with_sharding_constraint(packed, NamedSharding(mesh, P()))
    return jax.vmap(unpack)(packed)
