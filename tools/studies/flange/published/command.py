"""Runs the flange study: simulation, the authors' runs, both methods on real scans; writes tables, pictures and report."""

import time
from pathlib import Path

from weldcal.calibration.data.dataset import Dataset, load_dataset
from weldcal.calibration.flange.observation import Observation
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.tools.console import Progress
from weldcal.tools.report.files import write_json
from weldcal.tools.report.render import write_atomic
from weldcal.tools.studies.flange.published.clouds import CloudsOutcome, study_clouds
from weldcal.tools.studies.flange.published.pairs import (
    KinectOutcome,
    PairsOutcome,
    load_runs,
    study_kinect,
    study_pairs,
)
from weldcal.tools.studies.flange.published.report import pictures, study_report
from weldcal.tools.studies.flange.published.results import Study, StudyOptions
from weldcal.tools.studies.flange.published.simulation import simulate

NO_DATA = (
    "No data folder was given: only the simulated parts were run; give the folder that holds the recorded datasets."
)
TITLES = {"aubo_i5": "AUBO i5", "franka": "Franka Emika", "azure_kinect": "Azure Kinect"}
_SHARE_SIMULATION = 0.3
_LEAST_CLOUDS = 10
_USUAL_CLOUDS = 18  # more scans make each run of Algorithm 1 longer: fewer runs then, and the same time


def run_study(options: StudyOptions, progress: Progress) -> Study:
    """Run it and write table.json, figures/*.svg and report.html.

    Raises:
        InputError: the data folder does not exist or holds no dataset, before any work.
    """
    start = time.monotonic()
    found = find_datasets(options.data) if options.data is not None else []
    quick, seed = options.quick, options.seed
    levels, realisations = (5, 40) if quick else (50, 100)
    share = _SHARE_SIMULATION if found else 1.0
    simulation = simulate(
        levels=levels, realisations=realisations, seed=seed, progress=lambda what, done: progress(what, share * done)
    )
    pairs: list[PairsOutcome] = []
    clouds: list[CloudsOutcome] = []
    kinect: list[KinectOutcome] = []
    notes: list[str] = [] if found else [NO_DATA]
    for k, data in enumerate(found):
        name = data.folder.name
        begin, width = share + (1.0 - share) * k / len(found), (1.0 - share) / len(found)
        progress(name, begin)
        if data.pairs:
            observations = [Observation(p.id, p.X_BR, p.p_CR) for p in data.pairs]
            if "kinect" in data.header.scanner:
                kinect.append(study_kinect(name, observations, repeats=2 if quick else 10, seed=seed))
            else:
                runs = load_runs(data.folder)
                pairs.append(study_pairs(name, title(data), observations, runs, repeats=2 if quick else 10, seed=seed))
        elif len(data.clouds) < _LEAST_CLOUDS:
            scans = "1 scan" if len(data.clouds) == 1 else f"{len(data.clouds)} scans"
            notes.append(f"{name} holds {scans}, too few to hold any out: it is not used.")
        else:
            effort = min(1.0, (_USUAL_CLOUDS - 5) / (len(data.clouds) - 5))
            outcome = study_clouds(
                name,
                title(data),
                data,
                get_flange(data.header.flange),
                orders=2 if quick else max(5, round(50 * effort)),
                splits=3 if quick else max(5, round(60 * effort)),
                circles=4 if quick else None,
                seed=seed,
                progress=lambda what, done, at=begin, part=width: progress(what, at + part * done),  # type: ignore[misc]
            )
            clouds.append(outcome)
    study = Study(
        options=options,
        simulation=simulation,
        pairs=tuple(pairs),
        clouds=tuple(clouds),
        kinect=tuple(kinect),
        notes=tuple(notes),
        wall_seconds=time.monotonic() - start,
    )
    drawn = pictures(study)
    for name, picture in drawn.items():
        write_atomic(options.folder / "figures" / f"{name}.svg", picture)
    write_json(options.folder / "table.json", study.summary())
    write_atomic(options.folder / "report.html", study_report(study, drawn))
    return study


def find_datasets(folder: Path) -> list[Dataset]:
    """Every dataset in the folders of a folder (or the one that it is), by name. Raises InputError where there is none."""
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
