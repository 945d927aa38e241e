"""Loading cycles of soft tips by a fine integration: springs, dashpots and sliders, one lane for each tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STEPS = 40_000  # of a cycle: a thousandth of the shortest time or less

Lanes = np.ndarray
"""One number for each tip (n,), or for each dashpot or slider of each tip (n, m)."""


@dataclass(frozen=True, kw_only=True)
class LoadingTruth:
    """Tips that are pressed on a plate: N/m, s, m.

    `times_s` and `shares` (n, m) are of the dashpots: the share of the force of a fast press that each lets go. `loss`
    (n,) is the share of the work of a slow press that the sliders keep. `sliders_m` (n, m): over which deflections they
    begin to slide. `contact_N_per_m`: stiffness of contact and robot, which give way.
    """

    stiffness: Lanes
    times_s: Lanes
    shares: Lanes
    loss: Lanes
    sliders_m: Lanes
    contact_N_per_m: float = np.inf


def commanded(t: Lanes, press_m: float, speed_m_s: Lanes, hold_s: Lanes) -> Lanes:
    """Indentation m of a press at a speed, a hold, and the way back; then free."""
    up = press_m / speed_m_s
    indentation: Lanes = np.minimum(speed_m_s * t, press_m - speed_m_s * (t - up - hold_s)).clip(0.0, press_m)
    return indentation


def cycles(truth: LoadingTruth, press_m: float, speed_m_s: Lanes, hold_s: Lanes, rest_s: Lanes) -> np.ndarray:
    """Time s, indentation m, deflection m and force N (4, STEPS, n) of a cycle of each tip."""
    t = np.linspace(0.0, 2.0 * press_m / speed_m_s + hold_s + rest_s, STEPS)
    u, dt = commanded(t, press_m, speed_m_s, hold_s), t[1] - t[0]
    quick = truth.stiffness / (1.0 - truth.shares.sum(axis=1))  # all springs
    springs = truth.shares * quick[:, None]
    share = (dt[:, None] / truth.times_s).clip(0.0, 1.0)  # of a dashpot's way in a step
    b = truth.loss / (2.0 - truth.loss)  # a cycle 0 - X - 0 does k X^2 (1 + b) / 2, and returns k X^2 (1 - b) / 2
    length, slid = np.zeros_like(springs), np.zeros_like(truth.sliders_m)  # of the dashpots; where the sliders stand
    found, x = np.empty((2, *u.shape)), np.zeros(len(quick))

    def force(x: Lanes) -> Lanes:
        held = ((x[:, None] - slid) / truth.sliders_m).clip(-1.0, 1.0).mean(axis=1)
        pull: Lanes = truth.stiffness * x * (1.0 + b * held) + (springs * (x[:, None] - length)).sum(axis=1)
        return pull

    for i, indentation in enumerate(u):
        pressed = force(indentation) > 0.0
        loose, touching = x, x
        for _ in range(2):  # a free tip goes where nothing pulls at it; a contact gives way by its force
            loose = loose - force(loose) / quick
            touching = indentation - force(touching) / truth.contact_N_per_m
        x = np.where(pressed, touching, loose.clip(0.0))
        found[:, i] = x, np.where(pressed, force(x), 0.0)
        length += share * (x[:, None] - length)
        slid = slid.clip(x[:, None] - truth.sliders_m, x[:, None] + truth.sliders_m)
    return np.stack([t, u, *found])
