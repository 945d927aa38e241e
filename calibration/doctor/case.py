"""What the doctor examines: poses and flange measurements as arrays, written as a table and read back."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.data.checks import read_rows
from weldcal.calibration.data.dataset import Dataset
from weldcal.calibration.eye_on_base.observations import FlangeObservations
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, log_rotation, pose
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.files import write_apart
from weldcal.models.flanges import FlangeStandard
from weldcal.models.scanners import get_scanner

Which = NDArray[np.bool_] | NDArray[np.int64]

NAME = "observations.csv"
FEWEST = 5
"""Scans below which nothing is diagnosed."""
_POSE = ("x", "y", "z", "rx", "ry", "rz")
_SEEN = (*(f"centre_{a}" for a in "xyz"), *(f"normal_{a}" for a in "xyz"), "noise", "coverage")
_COLUMNS = ("id", *_POSE, *_SEEN)
_FEATURE, _GUESS = "the_feature_in_the_flange", "the_guess_of_X_BC"
_REFUSED = "refused"


@dataclass(frozen=True, eq=False)
class ArmDerivatives:
    """What joint zeros and link lengths of p numbers do.

    Change D (n, 3, p) of p_CR's place in the base, change T (n, 3, p) of the normals, and one sigma (p,) of the numbers
    for an arm as it leaves the factory.
    """

    D: Array
    T: Array
    sigma: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class DoctorCase:
    """n scans of a flange.

    X_BF (n, 4, 4) as the robot states it. X_FR (4, 4) of the feature. Centres c (n, 3) m and outward normals m (n, 3)
    in the camera (NaN rows: not found). ``time`` (n,) s or the order of the scans. ``noise`` (n,) m rms of each face
    about its plane (NaN: unknown). ``coverage`` (n,) visible share of the edge.

    ``robot`` names the arm; ``guess`` is X_BC (4, 4) as a user measured it, good to ``guess_radius`` m at the
    feature. ``flange`` is the stated designation, ``fits_flange`` the one that was found (empty: the stated one).
    ``refused`` lists (id, reason); ``near_far`` is the scanner's range, m; ``oriented`` is false for pairs that have
    positions only. ``asked`` is what the robot's motion asks of the scanner and no hole circle confirms, a sentence.
    Every fit holds the errors of the ``arm`` to their usual size (None: no fit has them).
    """

    ids: tuple[str, ...]
    X_BF: Array
    c: Array
    m: Array
    X_FR: Array = field(default_factory=lambda: np.eye(4))
    time: Array | None = None
    noise: Array | None = None
    coverage: Array | None = None
    robot: str = ""
    guess: Array | None = None
    guess_radius: float = 0.06
    flange: str = ""
    fits_flange: str = ""
    refused: tuple[tuple[str, str], ...] = ()
    near_far: tuple[float, float] | None = None
    oriented: bool = True
    arm: ArmDerivatives | None = None
    asked: str = ""

    @property
    def n(self) -> int:
        """How many scans."""
        return len(self.c)

    @property
    def X_BR(self) -> Array:
        """Poses of the feature in the base (n, 4, 4)."""
        return np.asarray(self.X_BF @ self.X_FR)

    @property
    def b(self) -> Array:
        """The feature's centres in the base (n, 3) m."""
        return np.asarray(self.X_BR[:, :3, 3])

    @property
    def z(self) -> Array:
        """The feature's normals in the base (n, 3)."""
        return np.asarray(self.X_BR[:, :3, 2])

    @property
    def clock(self) -> Array:
        """Time of each scan from 0 (first) to 1 (last); by order where no times are known."""
        t = np.arange(self.n, dtype=float) if self.time is None or not np.isfinite(self.time).all() else self.time
        span = float(t.max() - t.min())
        return np.asarray((t - t.min()) / span if span > 0.0 else np.linspace(0.0, 1.0, self.n))

    def with_poses(self, X_BF: Array) -> Self:
        """Return the same scans with other robot poses, to which no errors of the arm are known."""
        return replace(self, X_BF=X_BF, arm=None)

    def pick(self, which: Which) -> Self:
        """Some of the scans."""
        kept = np.arange(self.n)[which]

        def some(v: Array | None) -> Array | None:
            return None if v is None else np.asarray(v[kept])

        return replace(
            self,
            ids=tuple(self.ids[k] for k in kept),
            X_BF=self.X_BF[kept],
            c=self.c[kept],
            m=self.m[kept],
            time=some(self.time),
            noise=some(self.noise),
            coverage=some(self.coverage),
            arm=None if self.arm is None else replace(self.arm, D=self.arm.D[kept], T=self.arm.T[kept]),
        )


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
    """Return the case of observations in their order; X_FR (4, 4) is the feature in the flange."""
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


def case_text(case: DoctorCase) -> str:
    """Write the table of a case, a row for each scan (m, rad).

    The feature, the guess and the refused scans have rows of their own.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    words = {
        "robot": case.robot,
        "flange": case.flange,
        "oriented": int(case.oriented),
        "guess_radius": repr(case.guess_radius),
        "near_far": "" if case.near_far is None else ",".join(map(repr, case.near_far)),
        "asked": case.asked.replace(";", ","),
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
    """Return the case of such a table. Raises InputError where it is damaged."""
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
        asked=words.get("asked", ""),
    )


def _matrix(six: list[float]) -> Array:
    return pose(exp_rotation(np.array(six[3:])), np.array(six[:3]))
