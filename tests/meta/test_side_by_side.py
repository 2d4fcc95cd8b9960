"""How work is divided between devices, and numbers that learners may differ in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from emrld_jax.meta.side_by_side import make_mesh
from emrld_jax.settings import Settings, numbers, with_values


class Fake:
    """A device; a mesh looks at no more than its identity here."""


def shape(devices: int, learners: int, tasks: int) -> tuple[int, ...]:
    fakes: list[Any] = [Fake() for _ in range(devices)]
    mesh = make_mesh(fakes, learners, tasks)
    assert mesh.axis_names == ("learners", "tasks")
    return tuple(mesh.devices.shape)


@pytest.mark.parametrize(
    ("devices", "learners", "tasks", "expected"),
    [
        (1, 1, 12, (1, 1)),
        (4, 1, 12, (1, 4)),
        (4, 4, 12, (4, 1)),
        (4, 2, 12, (2, 2)),
        (4, 6, 12, (2, 2)),
        (3, 8, 12, (1, 3)),
        (8, 8, 7, (8, 1)),
    ],
)
def test_learners_are_divided_first(
    devices: int, learners: int, tasks: int, expected: tuple[int, int]
) -> None:
    assert shape(devices, learners, tasks) == expected


def test_what_cannot_be_divided_is_refused_with_what_can() -> None:
    with pytest.raises(ValueError, match=r"5 devices .* 1 run.* 12 tasks.*: 1, 2, 3, 4, 6$"):
        shape(5, 1, 12)


def test_numbers_are_the_settings_that_change_no_shape() -> None:
    names = numbers(Settings())
    assert {"w_rl", "w_bc", "adapt.learning_rate", "meta.max_kl"} <= set(names)
    assert not {"adapt.num_steps", "policy.activation", "policy.learn_std"} & set(names)
    assert all("." not in name or name.count(".") == 1 for name in names)


def test_values_are_put_in_by_name_and_the_rest_stays() -> None:
    settings = Settings()
    changed = with_values(settings, {"w_bc": 0.5, "meta.max_kl": np.float32(0.1)})
    assert (changed.w_bc, changed.meta.max_kl) == (0.5, np.float32(0.1))
    assert (changed.w_rl, changed.adapt) == (settings.w_rl, settings.adapt)
    assert settings == Settings()
