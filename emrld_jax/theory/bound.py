"""The lower bound of Theorem 3.2 on what a meta-iteration improves (supplement, section A)."""

from __future__ import annotations

from typing import Any, NamedTuple


class Terms(NamedTuple):
    """What the bound is made of; numbers or arrays [].

    Sums over time are discounted and count the steps before an episode's end only. Where no episode
    ever ends, `steps_old` and `steps_new` are 1 / (1 - discount), and this is the published bound.
    """

    surrogate: Any  # sum over the old policies' steps of E_{a ~ new} [advantage]; a return
    tv_old: Any  # D_TV(new, old), the mean over the old policies' steps; 0 to 1
    tv_demonstrator: Any  # D_TV(new, demonstrator), the mean over the new policies' steps; 0 to 1
    delta: Any  # Delta: what the demonstrator gains on the old policies everywhere, a step
    c1: Any  # C_1: the largest |advantage| of the old policies
    steps_old: Any  # sum over the old policies' steps of 1
    steps_new: Any  # the same of the new policies

    @property
    def surrogate_part(self) -> Any:
        """surrogate - 2 C_1 D_TV(new, old), summed over steps: never above 0 if all is exact."""
        return self.surrogate - 2.0 * self.c1 * self.steps_old * self.tv_old

    @property
    def demonstrator_part(self) -> Any:
        """Delta - 2 C_1 D_TV(new, demonstrator), summed over steps."""
        return self.steps_new * (self.delta - 2.0 * self.c1 * self.tv_demonstrator)

    @property
    def bound(self) -> Any:
        """What J_meta(new) - J_meta(old) is at least; a discounted return."""
        return self.surrogate_part + self.demonstrator_part
