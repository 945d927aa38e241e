"""Repeats the flange paper: simulation, the authors' runs, both methods on real scans; writes tables and pictures."""

import time
from pathlib import Path
from typing import Annotated

import typer

from weldcal.calibration.data.dataset import Dataset, load_dataset
from weldcal.calibration.flange.observation import Observation
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.console import Progress
from weldcal.tools.studies.flange.published.clouds import CloudsOutcome, study_clouds
from weldcal.tools.studies.flange.published.pairs import (
    KinectOutcome,
    PairsOutcome,
    load_runs,
    study_kinect,
    study_pairs,
)
from weldcal.tools.studies.flange.published.report import COST_HEADER, PublishedResults, cost_rows, pictures, tables
from weldcal.tools.studies.flange.published.simulation import simulate
from weldcal.tools.studies.flange.published.sphere import run_sphere_study, sphere_rows
from weldcal.tools.studies.harness import Study

NO_DATA = (
    "No data folder was given: only the simulated parts were run; give the folder that holds the recorded datasets."
)
TITLES = {"aubo_i5": "AUBO i5", "franka": "Franka Emika", "azure_kinect": "Azure Kinect"}
_SHARE_SIMULATION = 0.3
_LEAST_CLOUDS = 10
_USUAL_CLOUDS = 18  # more scans make each run of Algorithm 1 longer: fewer runs then, and the same time


def compute(data: Path | None, seed: int, quick: bool, progress: Progress) -> PublishedResults:
    """Everything, or the simulated parts where no folder of datasets is given.

    Raises:
        InputError: the data folder does not exist or holds no dataset, before any work.
    """
    found = find_datasets(data) if data is not None else []
    levels, realisations = (5, 40) if quick else (50, 100)
    share = _SHARE_SIMULATION if found else 1.0
    simulation = simulate(
        levels=levels, realisations=realisations, seed=seed, progress=lambda what, done: progress(what, share * done)
    )
    pairs: list[PairsOutcome] = []
    clouds: list[CloudsOutcome] = []
    kinect: list[KinectOutcome] = []
    notes: list[str] = [] if found else [NO_DATA]
    for k, dataset in enumerate(found):
        name = dataset.folder.name
        begin, width = share + (1.0 - share) * k / len(found), (1.0 - share) / len(found)
        progress(name, begin)
        if dataset.pairs:
            observations = [Observation(p.id, p.X_BR, p.p_CR) for p in dataset.pairs]
            if "kinect" in dataset.header.scanner:
                kinect.append(study_kinect(name, observations, repeats=2 if quick else 10, seed=seed))
            else:
                runs = load_runs(dataset.folder)
                pairs.append(
                    study_pairs(name, title(dataset), observations, runs, repeats=2 if quick else 10, seed=seed)
                )
        elif len(dataset.clouds) < _LEAST_CLOUDS:
            scans = "1 scan" if len(dataset.clouds) == 1 else f"{len(dataset.clouds)} scans"
            notes.append(f"{name} holds {scans}, too few to hold any out: it is not used.")
        else:
            effort = min(1.0, (_USUAL_CLOUDS - 5) / (len(dataset.clouds) - 5))
            outcome = study_clouds(
                name,
                title(dataset),
                dataset,
                get_flange(dataset.header.flange),
                orders=2 if quick else max(5, round(50 * effort)),
                splits=3 if quick else max(5, round(60 * effort)),
                circles=4 if quick else None,
                seed=seed,
                progress=lambda what, done, a=begin, b=width: progress(what, a + b * done),  # type: ignore[misc]
            )
            clouds.append(outcome)
    return PublishedResults(
        simulation=simulation, pairs=tuple(pairs), clouds=tuple(clouds), kinect=tuple(kinect), notes=tuple(notes)
    )


def find_datasets(folder: Path) -> list[Dataset]:
    """Every dataset in the folders of a folder (or the one that it is), by name.

    Raises InputError where there is none.
    """
    if not folder.is_dir():
        raise InputError(f"There is no folder '{folder}'; give the one that holds the recorded datasets.")
    inside = (
        [folder] if (folder / "dataset.yaml").is_file() else sorted(p.parent for p in folder.glob("*/dataset.yaml"))
    )
    if not inside:
        raise InputError(f"'{folder}' holds no dataset (a folder with dataset.yaml); give the one that does.")
    return [load_dataset(path) for path in inside]


def title(data: Dataset) -> str:
    """Robot and scanner as the paper names them."""
    robot = TITLES.get(data.header.robot, data.header.robot.upper().replace("E", "e"))
    scanner = data.header.scanner.replace("phoxi_", "PhoXi ").replace("azure_kinect", "Azure Kinect")
    return f"{robot} & {scanner[:-1] + scanner[-1].upper() if 'PhoXi' in scanner else scanner}"


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
    folder = call.folder("reproduce", "flange")
    start = time.monotonic()
    found = compute(data, call.seed, quick, call.progress)
    more = {"quick": quick, "seed": call.seed, "wall_seconds": time.monotonic() - start, "written_to": folder}
    paper = Study(
        name="flange",
        what="The flange paper repeated: the effect of Algorithm 1's cost (simulated, 1 mm of noise), and its data.",
        group="reproduce",
        figures=lambda results: {**found.summary(), **more},
        header=COST_HEADER,
        rows=lambda figures: cost_rows(found),
        others=lambda figures: tables(found),
        numbers=len(COST_HEADER) - 1,
        plots=pictures(found),
    )
    return paper.measured({}, folder).outcome()


@command("reproduce flange-sphere", short_help="Repeat Table 2 of the flange paper with a sphere.")
def flange_sphere(
    call: Call,
    scans: Annotated[int, option("--scans", "N", "Scans of the flange with a sphere on it.", min=20)] = 48,
    draws: Annotated[int, option("--draws", "N", "Random draws of 4 and of 16 of them.", min=1)] = 40,
) -> Outcome:
    """Repeat Table 2 of the flange paper in a simulated cell: a calibration sphere beside the flange, in the same
    scans; and the false segmentations of Table 1."""
    folder = call.folder("reproduce", "flange-sphere")
    summary = run_sphere_study(scans, draws, call.seed, call.progress)
    sphere = Study(
        name="flange-sphere",
        what=(
            "Table 2 of the flange paper in a simulated cell: a calibration sphere beside the flange, in the same"
            " scans."
        ),
        group="reproduce",
        figures=lambda results: results["all"],
        header=("calibration", "error at the flange"),
        rows=lambda figures: sphere_rows(summary).items(),
    )
    return sphere.measured({"all": summary}, folder).outcome()
