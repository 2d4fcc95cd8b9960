"""How exactly matrix products are computed: in float32, also on accelerators.

Their own default keeps 10 of the fraction's 23 bits, which `python -m benchmarks.precision`
compares. On a CPU products are always in float32.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def of_products() -> str:
    """What the user has asked for by JAX's own setting `jax_default_matmul_precision`, or float32.

    To be called while a function is traced.
    """
    asked: str | None = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
    return asked or "float32"


def dot(x: jax.Array, y: jax.Array) -> jax.Array:
    """x @ y. [S, F] and [F] -> [S], or [P] and [P] -> []."""
    return jnp.dot(x, y, precision=of_products())
