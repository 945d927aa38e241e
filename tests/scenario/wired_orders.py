"""Orders by wire, as the world that `emulate-cell` plays sees them: weaves, angles, stitches.

python -m tests.scenario.wired_orders FOLDER [weave] [order]
welds with the emulated controller. The last weave swings as often as the refusal of a faster one allows.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.worlds.robot.played import wired_world
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.cell import build_cell
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.weld import run_scenario
from weldcal.tools.report.run import RunOptions

SEAM_MM = 80.0
FASTEST = "{{shape: sine, amplitude_mm: 2.0, frequency_hz: {hz}}}"
WEAVES = [
    ("{shape: sine, amplitude_mm: 2.0, frequency_hz: 2.0}", 0.5),
    ("{shape: triangle, amplitude_mm: 2.0, frequency_hz: 1.25, dwell_s: [0.0, 0.1]}", 0.9),
    ("{shape: trapezoid, amplitude_mm: 1.5, frequency_hz: 1.0}", 1.0),
]


ORDERS = [
    "welding: {angles: {work_angle_deg: [-4, 4], travel_angle_deg: 1.4}}",
    "welding: {stitch: {on_mm: 15, off_mm: 10, order: middle_out}}",
]


@dataclass(frozen=True)
class Swings:
    """What the true torch has done: half of its mean range m, its period s and its mean path m, left and up."""

    amplitude_m: float
    period_s: float
    mean_m: Array
    side: Array

    def __str__(self) -> str:
        mean_mm = 1e3 * float(np.hypot(*self.mean_m))
        return f"amplitude {1e3 * self.amplitude_m:.3f} mm, {1.0 / self.period_s:.4f} Hz with dwells, mean {mean_mm:.3f} mm"


def swings(t: Array, left: Array, up: Array, period_s: float, plane_rad: float = 0.0) -> Swings:
    """Judge samples of the torch (n,) s, m; the period is that whose first three harmonics fit best."""
    side = np.cos(plane_rad) * left + np.sin(plane_rad) * up
    n = int((t[-1] - t[0]) / period_s)
    assert n >= 2
    parts = [side[(t >= t[0] + k * period_s) & (t < t[0] + (k + 1) * period_s)] for k in range(n)]
    periods = np.linspace(0.9, 1.1, 401) * period_s
    phases = 2.0 * np.pi * np.outer(np.arange(1, 4), t)
    left_over = []
    for period in periods:
        A = np.vstack([np.sin(phases / period), np.cos(phases / period), np.ones(len(t))]).T
        left_over.append(np.sum((side - A @ np.linalg.lstsq(A, side, rcond=None)[0]) ** 2))
    whole = t < t[0] + n * period_s
    mean = np.array([np.mean(left[whole]), np.mean(up[whole])])
    amplitude = float(np.mean([np.ptp(part) for part in parts])) / 2.0
    return Swings(amplitude, float(periods[np.argmin(left_over)]), mean, side)


def fastest(cell: Path) -> tuple[str, float]:
    """The weave of the largest frequency that the refusal of a faster one names, and its period s."""
    try:
        build_cell(load_scenario(str(cell), f"welding: {{weave: {FASTEST.format(hz=5.0)}}}"))
    except InputError as refusal:
        print(refusal)
        (named,) = re.findall(r"frequency_hz to ([\d.]+) at most", str(refusal))
        return FASTEST.format(hz=named), 1.0 / float(named)
    raise AssertionError("5 Hz are accepted.")


def weld(folder: Path, k: int, more: Callable[[Path], str]) -> Iterator[dict[str, Any]]:
    """Weld what `more` of the cell's file orders, by wire, and print how it ended; the world's truth where it welded."""
    with wired_world(folder / f"world{k}", f"127.31.0.{k + 7}", k + 1, SEAM_MM) as world:
        order = more(world.cell)
        options = RunOptions(scenario="wired", out=folder / f"job{k}", seed=k + 1, recording=False)
        found = run_scenario(load_scenario(str(world.cell), order), options).summary()
        truth = world.truth()
    print(order, found["state"], found.get("reason", ""), f"collisions {truth['collisions']}", sep="\n  ", flush=True)
    if truth.get("torch_s_left_up_mm"):
        yield truth


def main() -> None:
    """Weld each order by wire and print what the world saw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("kinds", nargs="*", default=["weave", "order"])
    words = parser.parse_args()
    for k in range(len(WEAVES) + 1 if "weave" in words.kinds else 0):
        found: list[float] = []

        def weave(cell: Path, k: int = k, found: list[float] = found) -> str:
            text, period_s = WEAVES[k] if k < len(WEAVES) else fastest(cell)
            found.append(period_s)
            return f"welding: {{weave: {text}}}"

        for truth in weld(words.folder.resolve(), k, weave):
            s, left, up = 1e-3 * np.array(truth["torch_s_left_up_mm"][0]).T
            t = truth["torch_every_s"] * np.arange(len(s))
            rows = t > 1.5 * found[0]
            print(" ", swings(t[rows], left[rows], up[rows], found[0]), f"over {1e3 * np.ptp(s):.1f} mm", flush=True)
    for k, order in enumerate(ORDERS if "order" in words.kinds else (), len(WEAVES) + 1):
        for truth in weld(words.folder.resolve(), k, lambda _, order=order: order):  # type: ignore[misc]
            spans = [np.array(burn)[:, 0] for burn in truth["torch_s_left_up_mm"]]
            print("  burns", ", ".join(f"{s[0]:.1f} to {s[-1]:.1f} mm" for s in spans))
            print(f"  torch at most {truth['torch_max_mm']:.3f} mm")


if __name__ == "__main__":
    main()
