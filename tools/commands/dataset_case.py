"""Make the doctor's case of a dataset, the poses as stated and what the scans show, and write it beside a result."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.doctor.case import FEWEST, NAME, DoctorCase, case_of, case_text
from weldcal.calibration.eye_on_base.observations import FlangeObservations, fit_flanges
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.flanges import FlangeStandard
from weldcal.models.result_files import write_apart
from weldcal.models.scanners import get_scanner
from weldcal.tools.cli.discovery import on_demand


def dataset_case(data: Dataset, seen: FlangeObservations, stated: FlangeStandard, found: FlangeStandard) -> DoctorCase:
    """What a dataset shows of the flange, as the doctor examines it."""
    X_BC, guess = data.X_BC_guess, data.header.scanner_guess
    try:
        preset = get_scanner(data.header.scanner)
        near_far = preset.near_m, preset.far_m
    except InputError:
        near_far = None
    return case_of(
        seen.observations,
        seen.fits,
        np.eye(4) if data.pairs else data.X_FR.GetAsMatrix4(),
        robot=data.header.robot,
        flange=stated.designation,
        refused=seen.refused,
        guess=None if X_BC is None else X_BC.GetAsMatrix4(),
        guess_radius=0.06 if guess is None else guess.radius_m,
        oriented=not data.pairs or all(p.has_orientation for p in data.pairs),
        fits_flange=found.designation,
        near_far=near_far,
    )


def write_case(folder: Path, case: DoctorCase) -> None:
    """Write the flange of each scan beside a result, for `weldcal doctor`."""
    write_apart(folder / NAME, case_text(case))


@contextmanager
def examined_where_refused(
    out: Path, data: Dataset, seen: FlangeObservations, standard: FlangeStandard, seed: int
) -> Iterator[None]:
    """Write the case to ``out`` where the block refuses five scans or more; the error goes on, with its likely cause.

    Where the dataset's guess of X_BC left too few scans, each scan is searched whole: the guess or the poses may be
    wrong.
    """
    try:
        yield
    except WeldcalError as problem:
        if len(seen.observations) < FEWEST and data.header.scanner_guess is not None:
            anywhere = replace(data, header=replace(data.header, scanner_guess=None))
            seen = fit_flanges(anywhere, standard, holes=False, seed=seed)
        if len(seen.observations) >= FEWEST:
            case = dataset_case(data, seen, standard, standard)
            write_case(out, case)
            on_demand("name_cause")(problem, case)
        raise
