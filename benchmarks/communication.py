"""What devices tell each other in a meta-iteration, read off the compiled programs.

`python -m benchmarks.communication env=point2d devices=4` counts the collective operations and
their bytes, and predicts from a link's latency and rate how long they take.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from math import prod

import jax

from benchmarks.choice import Choice, chosen, origin
from benchmarks.records import write_record
from emrld_jax.fields import setting
from emrld_jax.runs import cli
from emrld_jax.runs.config import check_config
from emrld_jax.runs.iteration import Together, initial
from emrld_jax.runs.machines import split_cpu
from emrld_jax.runs.setup import set_up, with_config

_KINDS = "all-reduce|all-gather|all-to-all|collective-permute"
_COLLECTIVE = re.compile(rf" = (.*?) ({_KINDS})(?:-start)?\(")
_OF_ONE = re.compile(r"replica_groups=(\{\{\d+\}|\[\d+,1\])")  # groups of one device
_ARRAY = re.compile(r"(f32|s32|u32|pred|f64|s64)\[([\d,]*)\]")
_BYTES = {"f32": 4, "s32": 4, "u32": 4, "pred": 1, "f64": 8, "s64": 8}
_CALLED = re.compile(r"(?:calls|to_apply|body)=%?([\w.\-]+)")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')


@dataclass
class CommunicationConfig(Choice):
    """All settings of the count."""

    num_seeds: int = setting(1, "seeds trained side by side", at_least=1)
    devices: int = setting(4, "devices that share the work", at_least=2)
    tries: int = setting(3, "tries of the line search", at_least=1)
    latency_us: float = setting(5.0, "us that a message takes from a device to the next", above=0)
    rate: float = setting(100.0, "GB/s that a device sends", above=0)


Told = Counter[tuple[str, int]]  # how often: (collective operation, bytes of a device)


def count(text: str, trips: Callable[[Told], int]) -> Told:
    """What a device tells the others when a compiled program, given as HLO, is executed once.

    Args:
        text: the program.
        trips: how often a loop goes round that does not know it itself, from what it tells.
    """
    computations: dict[str, list[str]] = {}
    entry = name = ""
    for line in text.splitlines():
        if line.endswith("{") and (start := re.match(r"(ENTRY )?%?([\w.\-]+)", line)):
            name = start.group(2)
            computations[name] = []
            entry = name if start.group(1) else entry
        elif name:
            computations[name].append(line)

    @cache
    def told_in(computation: str) -> Told:
        total: Told = Counter()
        for line in computations.get(computation, ()):
            if found := _COLLECTIVE.search(line):
                if not _OF_ONE.search(line):
                    total[found.group(2), _size(found.group(1))] += 1
                continue
            inside: Told = sum((told_in(c) for c in _CALLED.findall(line)), Counter())
            known = _TRIPS.search(line)
            times = 1 if " while(" not in line else int(known.group(1)) if known else None
            if inside:
                times = trips(inside) if times is None else times
                total += Counter({key: number * times for key, number in inside.items()})
        return total

    return told_in(entry)


def _size(arrays: str) -> int:
    return sum(
        _BYTES[kind] * prod(int(n) for n in shape.split(",") if n)
        for kind, shape in _ARRAY.findall(arrays)
    )


def main() -> int:
    """Counts, predicts and writes."""
    given = cli.parse(sys.argv[1:], CommunicationConfig(), {})
    config = cli.updated(CommunicationConfig(), given)
    check_config(config)
    split_cpu(config.devices)
    arguments = chosen(config)
    first = set_up(cli.train_config(arguments))
    seeds = range(config.num_seeds)
    setups = [with_config(first, replace(first.config, seed=seed)) for seed in seeds]
    together = Together(setups, jax.devices()[: config.devices])
    programs = together.compiled(together.begin([initial(setup) for setup in setups]))

    def trips(inside: Told) -> int:
        """Only Fisher-vector products tell vectors in a loop, only the line search numbers."""
        vectors = any(size > 1000 for _, size in inside)
        return first.config.meta.cg_iterations if vectors else config.tries

    told: Told = sum((count(str(program.as_text()), trips) for program in programs), Counter())
    operations = sum(told.values())
    size = sum(number * bytes_ for (_, bytes_), number in told.items())
    # in a ring of n devices an array goes around twice, in n parts, one step after the other
    steps = 2 * (max(together.shape.values()) - 1)
    seconds = 1e-6 * config.latency_us * steps * operations + 2 * size / (1e9 * config.rate)
    predicted = f"predicted ms, at {config.latency_us:g} us and {config.rate:g} GB/s"
    rows = {
        "collective operations": f"{operations}",
        "bytes of a device": f"{size}",
        predicted: f"{1e3 * seconds:.3f}",
    }
    lines = [f"{together.shape}", "", "| a meta-iteration | |", "|---|---|"]
    lines += [f"| {what} | {value} |" for what, value in rows.items()]
    lines += [f"| {kind} of {bytes_} bytes | {n} |" for (kind, bytes_), n in sorted(told.items())]
    record = {
        **origin("communication"),
        "mesh": together.shape,
        "operations": operations,
        "bytes": size,
        "predicted_s": seconds,
        "rows": [{"kind": k, "bytes": b, "times": n} for (k, b), n in sorted(told.items())],
    }
    name = f"communication-{config.env}-devices{config.devices}-seeds{config.num_seeds}"
    write_record(name, record, "\n".join(lines))
    return 0


if __name__ == "__main__":
    cli.run_command(main)
