"""What every run has: its options, and the section of its report on how late each velocity left the Diagram."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from weldcal.systems.runner import Run
from weldcal.systems.wall_clock import LIMITS_MS, ON_TIME_MS, Lateness
from weldcal.systems.wiring import Replacement
from weldcal.tools.report.first_screen import FirstScreen
from weldcal.tools.report.pictures import GREY, OURS, THEIRS, plain, subplots, svg
from weldcal.tools.report.render import fixed

KeepPage = Callable[[Callable[[FirstScreen | None, Path | None], None], Callable[[], None]], None]


def run_document(run: Run[Any], options: "RunOptions", robot: str) -> dict[str, object]:
    """Return what the JSON object of every run begins with."""
    found = {"state": "held" if run.held else "done", "scenario": options.scenario, "seed": options.seed}
    return {**found, "robot": robot, **({"reason": run.reason} if run.reason else {})}


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """The user's options of a run.

    Attributes:
        scenario: name or path.
        out: result folder.
        seed: of all random numbers.
        browser: open the dashboard in the browser.
        realtime: run no faster than real time.
        robot: see chosen_robot; None: the scenario's.
        dry_run, pace: see chosen_robot.
        speed_factor: speed of the arm's moves; None: the scenario's.
        recording: write the viewer's recording.html.
        share: show the dashboard, read-only, to the network too.
        record: write recording.mcap, which `weldcal replay` plays back.
        keep_page: takes the dashboard when the run has ended, as what shows its result and what closes it; None: it
            closes at once.
        replace: see build_cell.
    """

    scenario: str
    out: Path
    seed: int = 0
    browser: bool = False
    realtime: bool = False
    robot: str | None = None
    dry_run: bool = False
    pace: float | None = None
    speed_factor: float | None = None
    recording: bool = True
    share: bool = False
    record: bool = False
    keep_page: KeepPage | None = None
    replace: Mapping[str, Replacement] | None = None


def robot_timing(run: Run[Any]) -> dict[str, Any]:
    """What `base.html.j2` shows of the run's timing, as the context `robot_timing`; empty without a robot's clock."""
    clock = run.clock
    if clock is None or not sum(clock.lateness.counts):
        return {}
    late = clock.lateness
    slowed = (
        f"The path was slowed to {fixed(100.0 * clock.slowest_rate, 0)} % at the slowest, and took"
        f" {fixed(clock.slowed_s, 2)} s longer."
        if clock.slowest_rate < 1.0
        else "The path was never slowed."
    )
    return {
        "robot_timing": {
            "picture": histogram(late),
            "sentence": (
                f"{fixed(late.on_time_percent, 2)} % of {sum(late.counts)} velocities left less than {ON_TIME_MS:.0f}"
                f" ms late while the arm moved; the latest {fixed(late.worst_ms, 1)} ms. {slowed}"
                + ("" if run.host is None else f" This computer before the first motion: {run.host.words}.")
            ),
            "behind": clock.sentence(),
        }
    }


def histogram(late: Lateness) -> bytes:
    """The counts of each bin as bars on a logarithmic axis, as SVG."""
    names = [f"< {LIMITS_MS[0]:g}"]
    names += [f"{low:g} – {high:g}" for low, high in pairwise(LIMITS_MS)]
    names.append(f"≥ {LIMITS_MS[-1]:g}")
    on_time = LIMITS_MS.index(ON_TIME_MS) + 1
    figure, axes = subplots(7.2, 2.6)
    colours = [OURS if k < on_time else THEIRS for k in range(len(names))]
    axes.bar(range(len(names)), late.counts, color=colours, width=0.8)
    for k, count in enumerate(late.counts):
        axes.annotate(
            str(count), (k, max(count, 0.8)), ha="center", va="bottom", fontsize=8, color="black" if count else GREY
        )
    axes.set(yscale="log", ylim=(0.5, 5.0 * max(late.counts)))
    axes.set_xticks(range(len(names)), names)
    plain(axes, "late by, ms of robot time", "velocities")
    return svg(figure, axes)
