"""Meta-trains EMRLD on Point2D from Python, then adapts it to tasks that it never saw.

    python examples/train_from_python.py

Takes about half a minute on two cores; `--iterations 5` shows the shape of it in ten seconds.
"""

from __future__ import annotations

import argparse

import jax

from emrld_jax.runs.cli import train_config
from emrld_jax.runs.evaluation import evaluator
from emrld_jax.runs.setup import set_up


def main(iterations: int) -> None:
    # everything that `python -m emrld_jax.train` takes; the defaults are those tuned for Point2D
    setup = set_up(train_config(["env=point2d", "algo=emrld", "demos=optimal"]))
    learner, train, test = setup.learner, setup.demos.train, setup.demos.test

    state = learner.init(jax.random.key(0))
    for i in range(iterations):
        key = jax.random.fold_in(jax.random.key(1), i)
        state, metrics = learner.update(state, key, train.tasks, train.demos)
        before, after = metrics["adapt/return_0"], metrics["adapt/return_1"]
        print(f"iteration {i + 1}: return {before:.1f} before adaptation, {after:.1f} after")

    evaluate = evaluator(setup.env, learner, setup.config.adapt, episodes=20)
    result = evaluate(state.params, jax.random.key(2), test.tasks, test.demos)
    before, after = result.returns.mean(axis=(0, 2))  # [tasks, adaptation steps, episodes]
    print(f"held-out tasks: return {before:.1f} before adaptation, {after:.1f} after")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=60, help="meta-iterations (default 60)")
    main(parser.parse_args().iterations)
