"""Draw the pictures of the tutorials."""

from pathlib import Path
from typing import Any, cast

from matplotlib.figure import Figure

import weldcal


def draw_depth(cloud: Path, file: str) -> None:
    """Draw the depth of an organised scan into a file."""
    figure = cast(Any, Figure(figsize=(4, 3), layout="constrained"))
    axes = figure.add_subplot(title="depth, mm", xlabel="column", ylabel="row")
    figure.colorbar(axes.imshow(1e3 * weldcal.read_cloud(cloud)[..., 2]))
    figure.savefig(file)


def draw_joints(times: Any, off_deg: Any, file: str) -> None:
    """Draw six joint angles less their goals, (6, N) degrees, over time (s) into a file."""
    figure = cast(Any, Figure(figsize=(6, 3), layout="constrained"))
    axes = figure.add_subplot(xlabel="time, s", ylabel="joint less its goal, deg")
    for k in range(6):
        axes.plot(times, off_deg[k], label=f"joint {k + 1}")
    axes.legend(loc="lower right")
    figure.savefig(file)
