"""The study's world for the servo's tests: seams by their points, and a run as the tests read it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tests.worlds.weld.budgets import NOMINAL, Budget
from tests.worlds.weld.plant import simulate
from tests.worlds.weld.seams import TrueSeam, arcs, corner
from weldcal.welding.numerics import Array
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase, WeldingCommand, WeldingState


@dataclass(frozen=True, kw_only=True)
class Run:
    """A simulated weld, one row per tick."""

    time: Array
    torch: Array
    tool: Array
    tip: Array
    torch_on: Array
    phase: tuple[Phase, ...]
    commands: tuple[WeldingCommand, ...]
    state: WeldingState

    @property
    def last(self) -> WeldingCommand:
        return self.commands[-1]

    def phases(self) -> tuple[Phase, ...]:
        """The phases in order, each listed once per visit."""
        return tuple(p for i, p in enumerate(self.phase) if i == 0 or p != self.phase[i - 1])


def straight(length: float = 0.3) -> Array:
    """Points of a straight root line."""
    return arcs((length, 0.0), spacing=5e-3)


def l_curve(radius: float = 0.020, side: float = -1.0) -> Array:
    """An L of 300 mm turning by 90 deg, to the right when side is -1."""
    return corner(radius, 90.0, side)


def weld(
    points: Array,
    budget: Budget = NOMINAL,
    config: ServoConfig | None = None,
    seed: int = 0,
    gaps: tuple[tuple[float, float], ...] = (),
    hidden: tuple[float, float] = (math.inf, math.inf),
    plan: SeamCurve | None = None,
    time_limit: float = 90.0,
    up: Array | None = None,
) -> Run:
    """Run a whole weld of the groove with root line `points`; the tag is hidden between the two times given."""
    seam = TrueSeam("test", points, np.array((0.0, 0.0, 1.0)) if up is None else up)
    run = simulate(seam, budget, config or ServoConfig(), seed, gaps, time_limit, plan, hidden)
    on = np.array([c.torch_on for c in run.commands])
    phases = tuple(c.phase for c in run.commands)
    return Run(
        time=run.column("time_s"),
        torch=run.points("torch"),
        tool=run.points("robot"),
        tip=run.points("tip"),
        torch_on=on,
        phase=phases,
        commands=run.commands,
        state=run.state,
    )
