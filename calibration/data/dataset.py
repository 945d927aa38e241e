"""Reads, checks and writes a calibration dataset folder: poses, clouds and pairs."""

import csv
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.common.yaml import yaml_dump, yaml_load_typed
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.clouds import NO_NOTES, CloudError, find_cloud, read_cloud, save_cloud
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.tables import read_rows
from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.documents import parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import read_text, sha256
from weldcal.models.limits import LARGEST_DOCUMENT, LARGEST_NUMBER

UNITS = {"m": 1.0, "mm": 1e-3}
CONFIGURATIONS = ("eye_on_base",)
# Median distances that a flange has from its base, and a scanned point from its camera. The bounds are a factor of 1000 apart, so
# that metres called millimetres, or the reverse, always fall outside.
_REACH_M = (0.01, 10.0)
_SAMPLE = 10_000  # points whose distance is enough to tell metres from millimetres


@dataclass(frozen=True)
class Pair:
    """A centre found by other means: camera point (3,) m and the robot's pose of the feature (rotation identity where not
    given)."""

    id: str
    X_BR: RigidTransform
    p_CR: Array
    has_orientation: bool


@dataclass(frozen=True, eq=False)
class Dataset:
    """A dataset, checked. ``poses`` maps id to X_BF; ``clouds`` maps id to file; ``refused`` lists (id, reason)."""

    folder: Path
    header: DatasetHeader
    poses: dict[str, RigidTransform]
    clouds: dict[str, Path]
    pairs: tuple[Pair, ...]
    refused: tuple[tuple[str, str], ...]
    hashes: dict[str, str]

    def between(self, ids: str) -> Self:
        """The dataset without the scans before or after those named "FROM:TO" (ids; either may be left out), in its order.

        Raises DatasetError where there is no colon, an id is not in the dataset, or FROM stands after TO.
        """
        first, colon, last = (part.strip() for part in ids.partition(":"))
        known = [p.id for p in self.pairs] or list(self.clouds)
        if not colon:
            raise DatasetError(f"The poses '{ids}' are no range: write FROM:TO, FROM: or :TO with ids of the dataset.")
        for id in filter(None, (first, last)):
            if id not in known:
                raise DatasetError(
                    f"'{self.folder.name}' has no usable pose '{id}'; its poses go from {known[0]} to {known[-1]}."
                )
        begin, end = known.index(first) if first else 0, known.index(last) if last else len(known) - 1
        if begin > end:
            raise DatasetError(f"'{first}' comes after '{last}' in '{self.folder.name}'; write --poses {last}:{first}.")
        kept = set(known[begin : end + 1])
        return replace(
            self,
            clouds={id: path for id, path in self.clouds.items() if id in kept},
            pairs=tuple(p for p in self.pairs if p.id in kept),
        )

    @property
    def X_FR(self) -> RigidTransform:
        """Pose of the calibration feature in the flange frame."""
        f = self.header.feature_in_flange
        return RigidTransform(_quaternion(f.wxyz, "feature_in_flange"), f.xyz)

    def guess(self, id: str) -> RigidTransform | None:
        """Pose X_CR of the feature in the camera frame from the header's guess of X_BC; None without a guess."""
        g = self.header.scanner_guess
        if g is None:
            return None
        X_BC = RigidTransform(_quaternion(g.wxyz, "scanner_guess"), g.xyz)
        return X_BC.InvertAndCompose(self.poses[id] @ self.X_FR)

    def cloud(self, id: str) -> Array:
        """Points of one cloud in metres, (N, 3) or organised (H, W, 3). Raises CloudError with the reason."""
        unit = self.header.units.clouds
        points = read_cloud(self.clouds[id])
        points *= UNITS[unit]
        seen = points[np.isfinite(points[..., 2])]
        distance = float(np.median(np.linalg.norm(seen[:: 1 + len(seen) // _SAMPLE], axis=1)))
        if not _REACH_M[0] <= distance <= _REACH_M[1]:
            other = "mm" if unit == "m" else "m"
            raise CloudError(
                f"The points of {self.clouds[id].name} lie {distance:.3g} m from the camera, as {unit}: they look like {other}; correct "
                "units in dataset.yaml."
            )
        return points


def load_dataset(folder: Path) -> Dataset:
    """Read and check a dataset folder (dataset.yaml, and poses.csv with clouds/, or pairs.csv).

    Raises DatasetError, one sentence, for what makes the whole folder unusable: a missing or wrong file, an unknown
    unit or configuration, a cell that is not a number, a quaternion that is not a unit one, an id given twice, poses
    whose size shows the wrong unit. A cloud without a pose is an error; a pose without a cloud is refused by name;
    clouds themselves are read later. A scan
    that repeats another one to the last digit is refused by name.
    """
    folder = Path(folder)
    if folder.is_file():
        raise DatasetError(f"'{folder.name}' is a file; give the folder that holds it and dataset.yaml.")
    if not folder.is_dir():
        raise DatasetError(
            f"The dataset folder '{folder}' does not exist; give the path of a folder that holds dataset.yaml."
        )
    header = _header(folder / "dataset.yaml")
    hashes = {"dataset.yaml": _digest(folder / "dataset.yaml")}
    scale = UNITS[header.units.poses]
    if (folder / "poses.csv").is_file():
        hashes["poses.csv"] = _digest(folder / "poses.csv")
        poses = _poses(folder / "poses.csv", scale)
        clouds, refused = _match(folder / "clouds", poses)
        content, unreadable = _contents(clouds)
        clouds = {id: cloud for id, cloud in clouds.items() if id in content}
        refused += unreadable
        again = _repeated({id: (content[id], *poses[id].GetAsMatrix34().ravel()) for id in clouds})
        clouds = {id: cloud for id, cloud in clouds.items() if id not in dict(again)}
        if not clouds:
            raise DatasetError(
                f"No pose in '{folder.name}/poses.csv' has a cloud in clouds/; name the files after the ids, for "
                f"example {next(iter(poses), 'pose01')}.pcd."
            )
        hashes.update({f"clouds/{path.name}": content[id] for id, path in clouds.items()})
        return Dataset(folder, header, poses, clouds, (), refused + again, hashes)
    if (folder / "pairs.csv").is_file():
        hashes["pairs.csv"] = _digest(folder / "pairs.csv")
        pairs = _pairs(folder / "pairs.csv", scale, UNITS[header.units.clouds])
        again = _repeated({p.id: (*p.X_BR.GetAsMatrix34().ravel(), *p.p_CR) for p in pairs})
        pairs = tuple(p for p in pairs if p.id not in dict(again))
        return Dataset(folder, header, {}, {}, pairs, again, hashes)
    raise DatasetError(
        f"'{folder.name}' holds neither poses.csv nor pairs.csv; add poses.csv with the columns id,x,y,z,qw,qx,qy,qz."
    )


def save_dataset(
    folder: Path,
    header: DatasetHeader,
    poses: Mapping[str, RigidTransform],
    clouds: Mapping[str, Array],
    *,
    times: Mapping[str, float] | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
) -> None:
    """Record scans as a dataset folder that load_dataset reads back: X_BF and a cloud in metres ((N, 3) or (H, W, 3)) per id.

    ``times`` (s) adds the column `time`; ``intrinsics`` writes organised clouds as depth maps.
    ``header.units`` is written as metres. Raises DatasetError when the ids of poses and clouds differ.
    """
    if set(poses) != set(clouds):
        raise DatasetError("A recording needs one cloud for each pose; the ids of poses and clouds differ.")
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    document = {**asdict(header), "schema": 1, "units": {"clouds": "m", "poses": "m"}}
    (folder / "dataset.yaml").write_text(yaml_dump(document), encoding="utf-8")
    for id, points in clouds.items():
        save_cloud(folder / "clouds" / f"{id}.npz", points, intrinsics)
    with (folder / "poses.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["id", "x", "y", "z", "qw", "qx", "qy", "qz", *(["time"] if times else [])])
        for id, X_BF in poses.items():
            taken = [repr(float(times[id]))] if times else []
            writer.writerow([id, *map(repr, X_BF.translation().tolist()), *map(repr, _wxyz(X_BF)), *taken])


def _wxyz(X: RigidTransform) -> list[float]:
    q = X.rotation().ToQuaternion()
    return [float(v) for v in (q.w(), q.x(), q.y(), q.z())]


def _header(path: Path) -> DatasetHeader:
    if not path.exists():
        raise DatasetError(
            f"'{path.parent.name}' has no dataset.yaml; add one with schema, robot, flange, scanner, configuration "
            "and units."
        )
    try:
        text = read_text(path, LARGEST_DOCUMENT)
        parse_document(path.name, text)  # within bounds, no key twice
        header: DatasetHeader = yaml_load_typed(schema=DatasetHeader, data=text, defaults=DatasetHeader())
    except InputError as e:
        raise DatasetError(str(e)) from e
    except Exception as e:
        # pydrake raises whatever its YAML reader meets; the first line names the key
        raise DatasetError(f"'{path.name}' cannot be read as a dataset description: {str(e).splitlines()[0]}") from e
    if header.schema != 1:
        raise DatasetError(f"'{path.name}' says schema {header.schema}; this software reads schema 1.")
    for name, unit in (("clouds", header.units.clouds), ("poses", header.units.poses)):
        if unit not in UNITS:
            raise DatasetError(f"'{path.name}' gives the unit '{unit}' for {name}; write m or mm.")
    if header.configuration not in CONFIGURATIONS:
        raise DatasetError(
            f"'{path.name}' asks for the configuration '{header.configuration}'; calibrate handles "
            f"{', '.join(CONFIGURATIONS)}."
        )
    _check_poses(header, path)
    return header


def _check_poses(header: DatasetHeader, path: Path) -> None:
    """The lists of the header's poses: their lengths, finite numbers, metres, unit quaternions."""
    guess = header.scanner_guess
    for key, found in (("feature_in_flange", header.feature_in_flange), ("scanner_guess", guess)):
        if found is None:
            continue
        for name, values, n in ((f"{key}.xyz", found.xyz, 3), (f"{key}.wxyz", found.wxyz, 4)):
            if len(values) != n:
                raise DatasetError(f"'{path.name}': {name} must hold {n} numbers, not {len(values)}.")
            if not np.isfinite(values).all():
                raise DatasetError(f"'{path.name}': {name} holds a number that is not finite.")
        if float(np.abs(found.xyz).max()) > _REACH_M[1]:
            raise DatasetError(
                f"'{path.name}': {key}.xyz must be in metres; {_REACH_M[1]:g} m or more is no place of a scanner."
            )
        _quaternion(found.wxyz, key)
    if guess is not None and not 0.0 < guess.radius_m <= _REACH_M[1]:
        raise DatasetError(
            f"'{path.name}': scanner_guess.radius_m must be a positive number of metres up to {_REACH_M[1]:g}, not {guess.radius_m:g}."
        )


def _rows(path: Path, required: tuple[str, ...]) -> list[dict[str, str]]:
    try:
        names, rows = read_rows(path)
    except InputError as e:
        raise DatasetError(str(e)) from e
    missing = [c for c in required if c not in names]
    if missing:
        raise DatasetError(
            f"'{path.name}' lacks the column{'s' if len(missing) > 1 else ''} {', '.join(missing)}; the header is "
            f"{','.join(required)}."
        )
    if not rows:
        raise DatasetError(f"'{path.name}' holds no poses below its header.")
    seen: set[str] = set()
    for row in rows:
        if not row["id"] or Path(row["id"]).name != row["id"]:
            raise DatasetError(f"'{path.name}' has a row whose id '{row['id'][:40]}' is empty or not a plain name.")
        if row["id"] in seen:
            raise DatasetError(f"'{path.name}' gives the id '{row['id']}' twice; keep one row for each scan.")
        seen.add(row["id"])
    return rows


def _numbers(row: dict[str, str], columns: tuple[str, ...], path: Path) -> list[float]:
    out = []
    for c in columns:
        try:
            value = float(row[c])
        except ValueError:
            raise DatasetError(
                f"'{path.name}' has '{row[c][:40]}' in column {c} of '{row['id']}'; a number is needed."
            ) from None
        if not np.isfinite(value):
            raise DatasetError(
                f"'{path.name}' has {row[c]} in column {c} of '{row['id']}'; remove the row or give a finite number."
            )
        if abs(value) > LARGEST_NUMBER:
            raise DatasetError(f"'{path.name}' has {row[c]} in column {c} of '{row['id']}', beyond {LARGEST_NUMBER:g}.")
        out.append(value)
    return out


def _quaternion(wxyz: list[float], where: str) -> RotationMatrix:
    norm = float(np.linalg.norm(wxyz))
    if not abs(norm - 1.0) < 1e-3:
        raise DatasetError(
            f"The quaternion of '{where}' has the length {norm:.4f}; a rotation needs length 1 (order qw, qx, qy, qz)."
        )
    return RotationMatrix(Quaternion(np.asarray(wxyz) / norm))


def _check_reach(points: Array, path: Path, unit: str, of: str = "robot's base") -> None:
    reach = float(np.median(np.linalg.norm(points, axis=1)))
    if reach > _REACH_M[1] or reach < _REACH_M[0]:
        other = "mm" if unit == "m" else "m"
        raise DatasetError(
            f"The positions in '{path.name}' lie {reach:.4g} m from the {of}, which is out of reach: they look "
            f"like {other}; correct units in dataset.yaml."
        )


def _poses(path: Path, scale: float) -> dict[str, RigidTransform]:
    columns = ("x", "y", "z", "qw", "qx", "qy", "qz")
    poses = {}
    for row in _rows(path, ("id", *columns)):
        v = _numbers(row, columns, path)
        poses[row["id"]] = RigidTransform(_quaternion(v[3:], row["id"]), scale * np.array(v[:3]))
    _check_reach(np.array([X.translation() for X in poses.values()]), path, "m" if scale == 1.0 else "mm")
    return poses


def _pairs(path: Path, scale_base: float, scale_camera: float) -> tuple[Pair, ...]:
    base, camera, turn = (
        tuple(f"base_{c}" for c in "xyz"),
        tuple(f"camera_{c}" for c in "xyz"),
        tuple(f"base_q{c}" for c in "wxyz"),
    )
    pairs = []
    for row in _rows(path, ("id", *base, *camera)):
        v = _numbers(row, base + camera, path)
        given = [c for c in turn if row.get(c)]
        if given and len(given) < len(turn):
            missing = next(c for c in turn if c not in given)
            raise DatasetError(
                f"'{path.name}' lacks {missing} of '{row['id']}'; give all of {', '.join(turn)}, or none."
            )
        has = bool(given)
        R = _quaternion(_numbers(row, turn, path), row["id"]) if has else RotationMatrix()
        pairs.append(
            Pair(row["id"], RigidTransform(R, scale_base * np.array(v[:3])), scale_camera * np.array(v[3:]), has)
        )
    _check_reach(np.array([p.X_BR.translation() for p in pairs]), path, "m" if scale_base == 1.0 else "mm")
    spread_B = np.array([p.X_BR.translation() for p in pairs])
    spread_C = np.array([p.p_CR for p in pairs])
    a, b = (float(np.median(np.linalg.norm(s - np.median(s, axis=0), axis=1))) for s in (spread_B, spread_C))
    if min(a, b) > 0.0 and not 0.02 < a / b < 50.0:
        raise DatasetError(
            f"The robot positions in '{path.name}' spread {a / b:.3g} times as far as the camera's: one of them is in "
            "millimetres; correct units in dataset.yaml."
        )
    _check_reach(spread_C, path, "m" if scale_camera == 1.0 else "mm", "camera")
    return tuple(pairs)


def _match(folder: Path, poses: dict[str, RigidTransform]) -> tuple[dict[str, Path], tuple[tuple[str, str], ...]]:
    if not folder.is_dir():
        raise DatasetError(f"'{folder.parent.name}' has poses but no folder clouds/; add one cloud for each pose.")
    clouds: dict[str, Path] = {}
    refused: list[tuple[str, str]] = []
    for id in poses:
        try:
            clouds[id] = find_cloud(folder, id)
        except CloudError as e:
            refused.append((id, e.reason))
    orphans = [
        p
        for p in sorted(folder.iterdir())
        if p.suffix.lower() in NO_NOTES and p.stem not in poses and not p.name.startswith(".")
    ]
    if orphans:
        names = ", ".join(p.name for p in orphans[:5])
        raise DatasetError(
            f"'poses.csv' has no pose for {names}; add the missing row{'s' if len(orphans) > 1 else ''} or remove the "
            "cloud."
        )
    return clouds, tuple(refused)


def _repeated(scans: Mapping[str, tuple[object, ...]]) -> tuple[tuple[str, str], ...]:
    """Scans identical to another one, with the reason: a copy would count twice and predict itself in cross-validation."""
    first: dict[tuple[object, ...], str] = {}
    again = []
    for id, scan in scans.items():
        if (of := first.setdefault(scan, id)) != id:
            again.append((id, f"It repeats {of} to the last digit; it counts once."))
    return tuple(again)


def _contents(clouds: Mapping[str, Path]) -> tuple[dict[str, str], tuple[tuple[str, str], ...]]:
    """SHA-256 of each cloud, and those that are not regular files, with the reason."""
    found, refused = {}, []
    for id, cloud in clouds.items():
        try:
            found[id] = sha256(cloud)
        except InputError as e:
            refused.append((id, str(e)))
    return found, tuple(refused)


def _digest(path: Path) -> str:
    try:
        return sha256(path)
    except InputError as e:
        raise DatasetError(str(e)) from e
