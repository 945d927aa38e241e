"""weldcal reproduce: the published studies repeated, with every figure compared with its target."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Protocol

import typer

from weldcal.tools.cli.options import Call, Outcome, command, option, switch

MISSED = "Some targets were missed; see the table."


class Study(Protocol):
    """A study with targets."""

    @property
    def met(self) -> bool:
        """Whether all targets are met."""

    def summary(self) -> dict[str, object]:
        """The JSON object."""


@command("reproduce flange", short_help="Repeat the flange paper: tables, figures, Kinect data.")
def flange(
    call: Call,
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DATA]",
            help="Folder of the recorded datasets. Without it only the simulated parts are run.",
            show_default=False,
        ),
    ] = None,
    quick: Annotated[bool, switch("--quick", "Fewer noise levels, realisations, shuffled orders and splits.")] = False,
) -> Outcome:
    """Repeat the flange paper: Table 1, Fig. 9, 10 and 11, the Kinect data, and the effect of Algorithm 1's cost."""
    from weldcal.tools.studies.flange.published.command import run_study
    from weldcal.tools.studies.flange.published.report import print_study
    from weldcal.tools.studies.flange.published.results import StudyOptions

    study = run_study(StudyOptions(call.folder("reproduce", "flange"), data, call.seed, quick), call.progress)
    return Outcome(study.summary(), text=partial(print_study, study))


@command("reproduce flange-sphere", short_help="Repeat Table 2 of the flange paper with a sphere.")
def flange_sphere(
    call: Call,
    scans: Annotated[int, option("--scans", "N", "Scans of the flange with a sphere on it.", min=20)] = 48,
    draws: Annotated[int, option("--draws", "N", "Random draws of 4 and of 16 of them.", min=1)] = 40,
) -> Outcome:
    """Repeat Table 2 of the flange paper in a simulated cell: a calibration sphere beside the flange, in the same scans; and the false
    segmentations of Table 1."""
    from weldcal.tools.studies.flange.published.sphere import run_sphere_study, sphere_rows

    summary = run_sphere_study(call.folder("reproduce", "flange-sphere"), scans, draws, call.seed, call.progress)
    return Outcome(summary, rows=sphere_rows(summary))


def _compared(
    study: Study,
    *,
    rows: Mapping[str, str] | None = None,
    text: Callable[[], object] | None = None,
    missed: str = MISSED,
) -> Outcome:
    """The outcome of a study with targets: exit code 1 where one is missed."""
    return Outcome(study.summary(), {}, rows or {}, text, problem="" if study.met else missed)


def _names(listed: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in listed.split(",") if name.strip())
