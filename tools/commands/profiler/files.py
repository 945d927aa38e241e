"""Read profiler measurements from NPZ, tables, exports and folders into SI units (layouts: docs/profiler.md)."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from weldcal.calibration.data.checks import cut_off
from weldcal.calibration.data.poses.readings import PoseReading
from weldcal.calibration.profiler.arm_errors import DhArm
from weldcal.calibration.profiler.importing import import_profiles, profile_unit, profiles_of
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.reading_choice import Fit, choose_reading, flange_poses
from weldcal.models.array_files import AnyArray, read_npz
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_NUMBER, read_text, sha256
from weldcal.models.text_tables import lines_of

UNITS = {"m": 1.0, "mm": 1e-3}
NEAR_M = 0.02  # nor always this near
_OWN_FORM = "rotation_vector,rad"
FAR_M = 20.0  # no robot's flange is this far from its base

# other names of the same arrays, in files with one more axis for trials or worlds
ALIASES = {
    "scan_T": "T",
    "T_base_flange": "T",
    "Rb": "rotation",
    "Tb": "translation",
    "ps": "points",
    "prof": "profiles",
    "scan_prof": "profiles",
    "scan_sign": "sign",
    "scan_q": "q",
    "tip_nominal": "tip",
}
DIMENSIONS = {
    "T": 3, "rotation": 3, "translation": 2, "points": 2, "profiles": 3, "sign": 1, "translated": 1, "group": 1,
    "plane": 1, "q": 2, "touch_T": 3, "touch_q": 2, "tip": 1, "dh": 2, "scan_kind": 1, "dh_nominal": 2,
}  # fmt: skip
LENGTHS = ("translation", "points", "profiles", "tip", "radius", "sigma")


@dataclass(frozen=True)
class PosesStated:
    """What the user states of an export: poses' file and form, and points' distance (mm) where it holds heights."""

    poses: Path | None = None
    form: str = ""
    pitch_mm: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurements:
    """The contents of a file, in m and rad.

    Attributes:
        arrays: by the names of docs/profiler.md.
        profiles: raw profiles [x, z] (m, 2), or None.
        digest: SHA-256 of the file or of the files of the folder.
        warnings: sentences about the file.
        readings: the readings that the numbers of the poses allow, the used one first; empty where the file's form
            fixes one.
        reading: how the profiles and the poses were understood; empty for this package's own forms.
        notes: sentences about the reading that was chosen.
    """

    arrays: dict[str, Floats]
    profiles: tuple[Floats, ...] | None
    digest: str
    warnings: tuple[str, ...] = ()
    readings: tuple[PoseReading, ...] = ()
    reading: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def decided(self, fit: Fit, what: str) -> "Measurements":
        """Return the same with the reading of the poses that the profiles select.

        Raises InconsistentData where they select none.
        """
        if len(self.readings) < 2:
            return self
        k, sentence = choose_reading(self.readings, fit, what)
        return self.read_as(k, sentence)

    def read_as(self, k: int, sentence: str = "") -> "Measurements":
        """Return the same with one of the readings."""
        poses, one = flange_poses(self.readings[k]), self.readings[k]
        arrays = {**self.arrays, "rotation": poses.rotation, "translation": poses.translation}
        reading = {**self.reading, "robot": {**self.reading.get("robot", {}), "reading": one.form}}
        return replace(
            self,
            arrays=arrays,
            readings=(one,),
            reading=reading,
            notes=(*self.notes, *([sentence] if sentence else [])),
        )

    def with_form(self, form: str) -> "Measurements":
        """Return the same with the reading of this form where the numbers allow several and it is one of them."""
        k = next((k for k, one in enumerate(self.readings) if one.form == form), None)
        return (
            self if k is None or len(self.readings) < 2 else self.read_as(k, f"Poses read as {self.readings[k].words}.")
        )

    def poses(self, of: str = "") -> FlangePoses | None:
        """Flange poses of the scans, or of="touch_"; None where there are none."""
        T = self.arrays.get(f"{of}T")
        if T is not None:
            if T.ndim != 3 or T.shape[1:] not in ((4, 4), (3, 4)):
                raise InputError(f"{of}T holds poses (n, 4, 4), not {T.shape}.")
            if T.shape[1] == 4 and np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0) > 1e-6:
                raise InputError(
                    f"The last row of every {of}T is 0, 0, 0, 1. Check whether the matrices are transposed."
                )
            return FlangePoses.checked(T[:, :3, :3], T[:, :3, 3])
        R, t = self.arrays.get(f"{of}rotation"), self.arrays.get(f"{of}translation")
        return None if R is None or t is None else FlangePoses.checked(R, t)

    def needed(self, name: str, why: str) -> Floats:
        """Return an array that the command cannot do without.

        Raises:
            InputError: it is not there.
        """
        if name not in self.arrays:
            have = ", ".join(sorted(self.arrays)) or "nothing known"
            raise InputError(f"The file has no '{name}', {why}. It has {have}.")
        return self.arrays[name]

    def arm(self) -> DhArm | None:
        """Return the arm's table, where the file has one."""
        return DhArm.checked(self.arrays["dh"]) if "dh" in self.arrays else None


def read_profiler_file(
    path: Path,
    *,
    unit: str | None = None,
    dataset: str = "",
    trial: int | None = None,
    stated: PosesStated | None = None,
    posed: bool = True,
    alone: bool = True,
) -> Measurements:
    """Read an NPZ, a CSV, an export of a profiler or a folder with one file per profile.

    Args:
        unit: m or mm, of all lengths, where the file does not say; a CSV says it in its header.
        dataset: of an NPZ with several sets, the one whose names begin so; trial: which of its trials or worlds.
        stated: what the user states of an export's poses.
        posed: whether the flange's poses are read; they must be there.
        alone: False: the set is of another file that is read with it, where this one has none.

    Raises:
        InputError: missing or unreadable file, missing or implausible unit, no such set or trial.
    """
    if unit is not None and unit not in UNITS:
        raise InputError(f"The unit is m or mm, not '{unit}'.")
    stated = stated or PosesStated()
    if path.suffix.lower() == ".npz" and not path.is_dir():
        if stated != PosesStated():
            raise InputError("An NPZ holds its poses as T. Omit --poses and the keys robot-form and pitch of --as.")
        arrays, profiles = _from_npz(path, unit, dataset, trial, alone)
        file = Measurements(arrays=arrays, profiles=profiles, digest=sha256(path))
    elif posed:
        own = stated == PosesStated() and _is_own_table(path)
        file = _imported(path, unit, replace(stated, form=_OWN_FORM) if own else stated)
    else:
        bare = profiles_of(path, stated.pitch_mm)[0]
        profiles = tuple(UNITS[profile_unit(bare, unit)] * p for p in bare.points)
        file = Measurements(arrays={}, profiles=profiles, digest=digest_of(path))
    _check_numbers(path, file.arrays, file.profiles)
    X = file.poses()
    if not posed:
        return file
    if X is None:
        raise InputError("The file has no flange poses. Give 'T', or 'rotation' and 'translation'.")
    cure = "Correct the file's entry 'unit' to" if path.suffix.lower() == ".npz" and unit is None else "Give --unit"
    if len(X) and float(np.abs(X.translation).max()) > FAR_M:
        raise InputError(
            f"The flange would be {np.abs(X.translation).max():.0f} m from the base."
            f" {cure} mm if the lengths are in mm."
        )
    if len(X) and float(np.abs(X.translation).max()) < NEAR_M:
        raise InputError(
            f"The flange would be within {1e3 * np.abs(X.translation).max():.1f} mm of the base."
            f" {cure} m if the lengths are in m."
        )
    return file


def _is_own_table(path: Path) -> bool:
    """Return whether a table is in this package's own form: a flange position and a rotation vector in every row."""
    if path.suffix.lower() != ".csv" or path.is_dir():
        return False
    _, first = next(lines_of(read_text(path), ("#",)), (0, ""))
    return {"rx_rad", "ry_rad", "rz_rad"} <= set(re.split(r"[\s,;]+", first.lower()))


def _imported(path: Path, unit: str | None, stated: PosesStated) -> Measurements:
    """Return an export, a table with poses in another form, or a folder."""
    found = import_profiles(path, poses=stated.poses, form=stated.form, unit=unit, pitch_mm=stated.pitch_mm)
    poses = flange_poses(found.readings[0])
    arrays = {"rotation": poses.rotation, "translation": poses.translation}
    if found.profiles is not None and all(len(p) == 1 for p in found.profiles):
        arrays["points"] = np.vstack(found.profiles)
    if found.found is not None:
        arrays["points"] = found.found
    told = cut_off(path) if path.suffix.lower() == ".csv" and path.is_file() else None
    return Measurements(
        arrays=arrays,
        profiles=None if found.single else found.profiles,
        digest=digest_of(path, stated.poses),
        warnings=() if told is None else (told,),
        readings=found.readings,
        reading=found.reading,
    )


def digest_of(path: Path, poses: Path | None = None) -> str:
    """SHA-256 of a file, or of the files of a folder in the order of their names, and of the file of the poses."""
    if path.is_file() and poses is None:
        return sha256(path)
    whole = hashlib.sha256()
    for place in (path, *([] if poses is None else [poses])):
        files = [place] if place.is_file() else sorted(p for p in place.rglob("*") if p.is_file())
        for one in files:
            whole.update(sha256(one).encode())
    return whole.hexdigest()


def _check_numbers(path: Path, arrays: dict[str, Floats], profiles: tuple[Floats, ...] | None) -> None:
    """Refuses numbers that are infinite or so large that their squares are; NaN marks a missing point."""
    for name, value in {**arrays, **{f"profile {k}": p for k, p in enumerate(profiles or ())}}.items():
        if not float(np.nanmax(np.abs(value), initial=0.0)) <= LARGEST_NUMBER:
            raise InputError(f"'{path.name}': {name} holds a number that is infinite or beyond {LARGEST_NUMBER:g}.")


def _from_npz(
    path: Path, unit: str | None, dataset: str, trial: int | None, alone: bool
) -> tuple[dict[str, Floats], tuple[Floats, ...] | None]:
    raw: dict[str, AnyArray] = read_npz(path)
    said = str(raw.pop("unit")) if "unit" in raw else unit
    if said is None:
        raise InputError("The file does not state its unit of length. Add --unit mm or --unit m, or an entry 'unit'.")
    if said not in UNITS:
        raise InputError(f"The file's unit is '{said}'. It must be m or mm.")
    if unit is not None and unit != said:
        raise InputError(f"The file states the unit {said}. Omit --unit {unit}.")
    scale = UNITS[said]
    sets = sorted({name[: -len("_Rb")] for name in raw if name.endswith("_Rb")})
    if sets and dataset not in sets:
        raise InputError(f"The file has several sets. Choose one with --as set={' | set='.join(sets)}.")
    if dataset and not sets and alone:
        raise InputError(f"The file has no sets. Omit --as set={dataset}.")
    if dataset and sets:
        level = raw.get(f"sigma_{dataset.rsplit('_', 1)[-1]}")  # of the noise that the set is named after
        raw = {
            name.removeprefix(f"{dataset}_"): v
            for name, v in raw.items()
            if name.startswith(f"{dataset}_") or name == "radius"
        }
        if level is not None:
            raw["sigma"] = level
    if "sigma" in raw and np.shape(raw["sigma"]) != (3,):
        raise InputError("The file's 'sigma' holds three numbers: of the robot, of a profile's x and of its z.")
    arrays: dict[str, Floats] = {}
    for name, value in raw.items():
        if value.dtype.kind not in "fiub":
            continue
        key = ALIASES.get(name, name)
        value = np.asarray(value, float)
        if key in DIMENSIONS and value.ndim == DIMENSIONS[key] + 1:
            value = _of_trial(value, trial)
        arrays[key] = value * scale if key.removeprefix("touch_") in LENGTHS else value
    for name in ("T", "touch_T"):
        if name in arrays and arrays[name].ndim == 3 and arrays[name].shape[1:] in ((4, 4), (3, 4)):
            arrays[name][:, :3, 3] *= scale
    if "scan_kind" in arrays:
        arrays["translated"] = (arrays.pop("scan_kind") == 0).astype(float)
    if "dh_nominal" in arrays:  # lengths in the file's unit, angles in degrees
        arrays["dh"] = arrays.pop("dh_nominal") * [scale, np.radians(1.0), scale, np.radians(1.0)]
    elif "dh" in arrays:
        arrays["dh"] = arrays["dh"] * [scale, 1.0, scale, 1.0]
    profiles = None
    if "n" in arrays and "xz" in raw:
        if raw["xz"].ndim != 2 or raw["xz"].shape[1] != 2:
            raise InputError(f"'xz' holds profile points [x, z] (n, 2), not an array of shape {raw['xz'].shape}.")
        n = arrays["n"].astype(int) if np.isfinite(arrays["n"]).all() else np.zeros(0, int)
        if n.ndim != 1 or (n < 0).any() or (n != arrays["n"]).any() or raw["xz"].dtype.kind not in "fiub":
            raise InputError("The profiles' lengths 'n' must be whole numbers, one for each profile, and 'xz' numbers.")
        if n.sum() != len(raw["xz"]):
            raise InputError(f"The profiles' lengths 'n' add up to {n.sum()}, and 'xz' has {len(raw['xz'])} points.")
        profiles = tuple(np.split(np.asarray(raw["xz"], float) * scale, np.cumsum(n)[:-1]))
    elif "profiles" in arrays:
        if arrays["profiles"].ndim != 3 or arrays["profiles"].shape[2] != 2:
            raise InputError(
                f"Profiles hold points [x, z] (n, m, 2), not an array of shape {arrays['profiles'].shape}."
            )
        profiles = tuple(arrays["profiles"])
    return arrays, profiles


def _of_trial(value: Floats, trial: int | None) -> Floats:
    if trial is None:
        if len(value) == 1:
            return np.asarray(value[0])
        raise InputError(f"The file has {len(value)} trials. Choose one with --as trial=0 to {len(value) - 1}.")
    if not 0 <= trial < len(value):
        raise InputError(f"There is no trial {trial}. The file has 0 to {len(value) - 1}.")
    return np.asarray(value[trial])
