"""Writes what a calibration saw of the flange as a table, and reads it back as a case for the doctor."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from weldcal.calibration.data.tables import read_rows
from weldcal.calibration.doctor.case import DoctorCase
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, log_rotation, pose
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

NAME = "observations.csv"
_POSE = ("x", "y", "z", "rx", "ry", "rz")
_SEEN = (*(f"centre_{a}" for a in "xyz"), *(f"normal_{a}" for a in "xyz"), "noise", "coverage")
_COLUMNS = ("id", *_POSE, *_SEEN)
_FEATURE, _GUESS = "the_feature_in_the_flange", "the_guess_of_X_BC"
_REFUSED = "refused"


def case_of(
    observations: Sequence[Observation],
    fits: Mapping[str, FlangeFit],
    X_FR: Array,
    *,
    robot: str,
    flange: str,
    refused: Sequence[tuple[str, str]] = (),
    guess: Array | None = None,
    guess_radius: float = 0.06,
    oriented: bool = True,
    fits_flange: str = "",
    near_far: tuple[float, float] | None = None,
) -> DoctorCase:
    """The case of observations in their order; X_FR (4, 4) is the feature in the flange."""
    nan = np.full(3, np.nan)
    X_BR = np.array([o.X_BR.GetAsMatrix4() for o in observations]).reshape(-1, 4, 4)
    return DoctorCase(
        ids=tuple(o.id for o in observations),
        X_BF=X_BR @ inverse(X_FR),
        c=np.array([o.p_CR for o in observations]).reshape(-1, 3),
        m=np.array([nan if o.n_C is None else o.n_C for o in observations]).reshape(-1, 3),
        X_FR=X_FR,
        noise=np.array([fits[o.id].plane_rms_m if o.id in fits else np.nan for o in observations]),
        coverage=np.array([fits[o.id].coverage if o.id in fits else np.nan for o in observations]),
        robot=robot if oriented else "",
        guess=guess,
        guess_radius=guess_radius,
        flange=flange,
        fits_flange=fits_flange,
        refused=tuple(refused),
        near_far=near_far,
        oriented=oriented,
    )


def case_text(case: DoctorCase) -> str:
    """The table: a row for each scan (m, rad), with the feature, the guess and the refused scans as rows of their
    own."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    words = {
        "robot": case.robot,
        "flange": case.flange,
        "oriented": int(case.oriented),
        "guess_radius": repr(case.guess_radius),
        "near_far": "" if case.near_far is None else ",".join(map(repr, case.near_far)),
    }
    out.write(f"# {';'.join(f'{name}={word}' for name, word in words.items())}\n")
    writer.writerow(_COLUMNS)
    rows = [(_FEATURE, case.X_FR), *([] if case.guess is None else [(_GUESS, case.guess)])]
    for name, X in rows:
        writer.writerow([name, *_six(X), *[""] * len(_SEEN)])
    nothing = np.full(case.n, np.nan)
    noise, coverage = (nothing if v is None else v for v in (case.noise, case.coverage))
    for k, id in enumerate(case.ids):
        seen = [*case.c[k], *case.m[k], noise[k], coverage[k]]
        writer.writerow([id, *_six(case.X_BF[k]), *("" if not np.isfinite(v) else repr(float(v)) for v in seen)])
    for id, _ in case.refused:
        writer.writerow([f"{_REFUSED}:{id}", *[""] * (len(_COLUMNS) - 1)])
    return out.getvalue()


def _six(X: Array) -> list[str]:
    return [repr(float(v)) for v in (*X[:3, 3], *log_rotation(X[None, :3, :3])[0])]


def read_case(path: Path) -> DoctorCase:
    """The case of such a table. Raises InputError where it is damaged."""
    names, rows = read_rows(path)
    if tuple(names) != _COLUMNS:
        raise InputError(f"'{path.name}' is no table of observations that 'weldcal calibrate' wrote.")
    first = path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
    words = dict(part.split("=", 1) for part in first.split(";") if "=" in part)
    try:
        poses = {r["id"]: _matrix([float(r[c]) for c in _POSE]) for r in rows if not r["id"].startswith(f"{_REFUSED}:")}
        scans = [r for r in rows if r["id"] not in (_FEATURE, _GUESS) and not r["id"].startswith(f"{_REFUSED}:")]
        seen = np.array([[float(r[c]) if r[c] else np.nan for c in _SEEN] for r in scans]).reshape(-1, len(_SEEN))
        radius = float(words.get("guess_radius", 0.06))
        near_far = [float(v) for v in words.get("near_far", "").split(",") if v]
    except ValueError as e:
        raise InputError(f"'{path.name}' holds something that is not a number: {e}.") from e
    ids = tuple(r["id"] for r in scans)
    if not np.isfinite(seen[:, :3]).all() or not all(np.isfinite(X).all() for X in poses.values()):
        raise InputError(f"'{path.name}' lacks a number of a scan.")
    return DoctorCase(
        ids=ids,
        X_BF=np.array([poses[i] for i in ids]).reshape(-1, 4, 4),
        c=seen[:, :3],
        m=seen[:, 3:6],
        X_FR=poses.get(_FEATURE, np.eye(4)),
        noise=seen[:, 6],
        coverage=seen[:, 7],
        robot=words.get("robot", ""),
        guess=poses.get(_GUESS),
        guess_radius=radius,
        flange=words.get("flange", ""),
        refused=tuple((r["id"].split(":", 1)[1], "") for r in rows if r["id"].startswith(f"{_REFUSED}:")),
        near_far=(near_far[0], near_far[1]) if len(near_far) == 2 else None,
        oriented=words.get("oriented", "1") != "0",
    )


def _matrix(six: list[float]) -> Array:
    return pose(exp_rotation(np.array(six[3:])), np.array(six[:3]))
