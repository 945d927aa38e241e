"""Import profiles with flange poses.

A table, an export with poses in a file beside it, or a folder with one file per profile.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.bag import find_bag
from weldcal.calibration.data.poses.formats import may_hold_poses
from weldcal.calibration.data.poses.listing import Listing
from weldcal.calibration.data.poses.lists import folder_lists, pose_a_file, read_lists, together
from weldcal.calibration.data.poses.names import natural, number_of
from weldcal.calibration.data.poses.readings import PoseReading, pick
from weldcal.calibration.data.poses.source import robot_list, unit_by_size
from weldcal.calibration.data.poses.trees import stacked
from weldcal.calibration.geometry.se3 import scaled
from weldcal.calibration.profiler.exports import (
    SECONDS,
    TABLES,
    TREES,
    UNITS,
    Profiles,
    joined,
    listed_columns,
    read_profiles,
)
from weldcal.calibration.profiler.motion import Floats
from weldcal.calibration.profiler.text_blocks import blocks_of
from weldcal.models.errors import InputError
from weldcal.models.files import read_text

_POSE_NAME = re.compile(r"(?i)(^|[^a-z])(pos|rob)\d*($|[^a-z])|pose|robot|flange|tcp|tool")
_WIDE = 1.0  # a laser line of more than this is in millimetres
_MOST_FILES = 20_000
_OPTION = "--as robot-form"


@dataclass(frozen=True, eq=False, kw_only=True)
class ImportedProfiles:
    """Profiles and flange poses, in metres.

    Attributes:
        profiles: points [x, z] (m, 2) of each profile, or None where the file holds poses only.
        readings: all readings of the flange poses X_BF (n, 4, 4), the usual one first.
        single: whether each profile is one point.
        reading: how the file was understood: file, form and unit of the profiles and of the poses, and the rows left
            out.
        found: the edge's point [x, z] (n, 2) m in each profile, where the files hold it.
    """

    profiles: tuple[Floats, ...] | None
    readings: tuple[PoseReading, ...]
    single: bool
    reading: dict[str, dict[str, object]]
    found: Floats | None = None


def import_profiles(
    path: Path, *, poses: Path | None = None, form: str = "", unit: str | None = None, pitch_mm: float | None = None
) -> ImportedProfiles:
    """Return the profiles and poses of a file or folder.

    Args:
        path: a table, an export of a profiler, or a folder with one file per profile.
        poses: a file of the flange's poses, one for each profile; without it the same table or a file beside it.
        form: how the poses are written, where the user states it.
        unit: m or mm, of lengths that the file does not state.
        pitch_mm: distance of neighbouring points where the file holds heights only.

    Raises:
        InputError: no profiles, no poses, or different numbers of both; the sentence names what was found.
    """
    try:
        found, beside = profiles_of(path, pitch_mm)
    except InputError as problem:
        only = None if path.is_dir() or pitch_mm is not None else _poses_only(path)
        if only is None:
            raise problem
        listing = only.stated(PoseForm(rotation=form), _OPTION) if form else only
        readings, words = _metric_poses(listing, np.flatnonzero(listing.good), unit)
        return ImportedProfiles(profiles=None, readings=readings, single=False, reading={"robot": words})
    listing = _poses(path, found, beside, poses)
    if form:
        listing = listing.stated(PoseForm(rotation=form), _OPTION)
    same = {number_of(i) for i in listing.ids} == {number_of(i) for i in found.ids}
    seconds = found.times * SECONDS[found.time_unit] if found.times is not None and found.time_unit else None
    ids = found.ids if same or len(found) != len(listing) else ()
    shown = Listing(name=found.source, numbers=(), ids=ids, times=seconds, joints=np.zeros((len(found), 0)))
    rows, kept, _ = together(listing, shown)
    alone = [
        f"{one.ids[k] if one.ids else f'row {k + 1}'} of {one.name}: It has no partner."
        for one, used in ((listing, rows), (shown, kept))
        for k in range(len(one))
        if k not in set(used.tolist())
    ]
    good = listing.good[rows]
    rows, kept = rows[good], kept[good]
    if not len(rows):
        why = f": {listing.left_out[0][1]}" if listing.left_out else "."
        raise InputError(
            f"'{listing.name}' holds no pose for any of the {len(found)} profiles of '{found.source}'{why}"
        )
    readings, words = _metric_poses(listing, rows, unit, alone)
    length = profile_unit(found, unit)
    profiles = tuple(UNITS[length] * found.points[k] for k in kept)
    reading: dict[str, dict[str, object]] = {
        "profiles": {
            "file": found.source,
            "form": found.form,
            "unit": length,
            "profiles": len(found),
            "used": len(kept),
        },
        "robot": words,
    }
    points = None if found.found is None else UNITS[length] * found.found[kept]
    return ImportedProfiles(profiles=profiles, readings=readings, single=found.single, reading=reading, found=points)


def _poses_only(path: Path) -> Listing | None:
    """Return the poses of a file without profiles.

    None where it holds none, or numbers without names, which may be heights.
    """
    try:
        if path.suffix.lower() in TABLES and any(not b.header for b in blocks_of(read_text(path), path.name)):
            return None
        lists = read_lists(path)
        return robot_list(lists, path.name, PoseForm()) if lists else None
    except InputError:
        return None


def profiles_of(path: Path, pitch_mm: float | None = None) -> tuple[Profiles, list[Path]]:
    """Return the profiles of a file or folder, and the files that may hold the poses."""
    if not path.is_dir():
        return read_profiles(path, pitch_mm), _beside(path)
    files = [
        p
        for place in (path, *sorted(q for q in path.iterdir() if q.is_dir() and not q.name.startswith((".", "_"))))
        for p in sorted(place.iterdir(), key=lambda q: natural(q.name))
        if p.is_file()
        and (p.suffix.lower() in (*TABLES, *TREES) or may_hold_poses(p))
        and not p.name.startswith((".", "_"))
    ]
    if len(files) > _MOST_FILES:
        raise InputError(f"'{path.name}' holds {len(files)} files, more than {_MOST_FILES}, the most that are read.")
    poses = [p for p in files if _is_pose_name(p, path)]
    files = [p for p in files if p not in set(poses) and p.suffix.lower() in (*TABLES, *TREES)]
    groups: dict[tuple[Path, str, str], list[Path]] = {}
    for p in files:
        stem = re.sub(r" ?\(\d+\)$|\d+", "", p.stem)  # copies are "a.txt", "a (1).txt"
        groups.setdefault((p.parent, stem, p.suffix.lower()), []).append(p)
    if not groups:
        names = ", ".join(p.name for p in poses[:4]) or "no table"
        raise InputError(
            f"'{path.name}' holds {names} and no profiles. Put one CSV for each profile into it, such as"
            " profile_01.csv."
        )
    chosen = max(groups.values(), key=len)
    rest = [p for p in files if p not in set(chosen)]
    if len(chosen) == 1 and len(rest) == 1 and not poses:  # an export, and poses under any name
        for one, other in ((chosen[0], rest[0]), (rest[0], chosen[0])):
            try:
                return read_profiles(one, pitch_mm), [other]
            except InputError:
                continue
    if len(chosen) == 1:
        return read_profiles(chosen[0], pitch_mm), poses or rest
    parts = [_as_one(read_profiles(p, pitch_mm)) for p in chosen]
    many = next((p for p in parts if len(p) != 1), None)
    if many is not None:
        raise InputError(
            f"'{many.source}' holds {len(many)} profiles, and there are {len(parts)} such files; give one profile a"
            " file, or one file."
        )
    whole = joined(parts, path.name)
    lists = [p.poses for p in parts if p.poses is not None]
    if len(lists) == len(parts):
        whole = replace(whole, poses=stacked([replace(one, ids=()) for one in lists], path.name, whole.ids))
    return whole, poses or rest


def _as_one(found: Profiles) -> Profiles:
    """Return the rows of one file, each with a time of its own, as one profile at the first time."""
    if not found.single or found.times is None or found.poses is not None:
        return found
    return replace(found, points=(np.vstack(found.points),), ids=(), times=found.times[:1], single=False)


def _is_pose_name(path: Path, folder: Path) -> bool:
    return bool(_POSE_NAME.search(path.stem)) or (path.parent != folder and bool(_POSE_NAME.search(path.parent.name)))


def _beside(path: Path) -> list[Path]:
    """Files beside an export that may hold its poses: those that carry its name first."""
    try:
        others = [
            p
            for p in path.parent.iterdir()
            if p != path
            and p.is_file()
            and may_hold_poses(p)
            and _POSE_NAME.search(p.stem)
            and not p.name.startswith(".")
        ]
    except OSError:
        return []
    mine = [p for p in others if path.stem.lower() in p.stem.lower()]
    return sorted(mine or others, key=lambda p: natural(p.name))


def _poses(path: Path, found: Profiles, beside: Sequence[Path], stated: Path | None) -> Listing:
    """Return the list of the flange's poses: the stated file's, the table's own, or that of the files beside."""
    if stated is not None:
        bag = find_bag(stated) if stated.exists() else None
        lists = folder_lists(stated, 1) if bag is None and stated.is_dir() else read_lists(bag or stated)
        return robot_list(lists, stated.name, PoseForm())
    if found.poses is not None:
        return found.poses
    single = [p for p in beside if number_of(p.stem) is None] or list(beside)
    if len(single) > 1 and len({re.sub(r"\d+", "", p.name) for p in single}) > 1:
        fitting = []
        for p in single:
            try:
                one = _listing([p], p.name)
            except InputError:
                continue
            if len(one) == len(found):
                fitting.append((p, one))
        if len(fitting) == 1:
            return fitting[0][1]
        if fitting:
            raise InputError(
                f"{', '.join(p.name for p, _ in fitting)} each hold {len(found)} poses; name the file of the flange's"
                " with --poses FILE."
            )
    elif single:
        try:
            return _listing(single, path.name)
        except InputError:
            if any(_POSE_NAME.search(p.stem) or _POSE_NAME.search(p.parent.name) for p in single):
                raise
    raise InputError(_no_poses(found))


def _no_poses(found: Profiles) -> str:
    size = int(np.median([len(p) for p in found.points]))
    columns = f" Its columns are {listed_columns(found)}." if found.columns else ""
    kind = f" ({found.form})" if found.form else ""
    return (
        f"'{found.source}'{kind} holds {len(found)} profiles of {size} points and no flange pose.{columns} Add a"
        " file poses.csv beside it, or name one with --poses FILE. It has one row for the flange's pose at each"
        " profile:"
        " x_mm,y_mm,z_mm,qw,qx,qy,qz (or x_mm,y_mm,z_mm,a_deg,b_deg,c_deg of a KUKA)."
    )


def _listing(files: Sequence[Path], name: str) -> Listing:
    if len(files) == 1:
        return robot_list(read_lists(files[0]), files[0].name, PoseForm())
    return pose_a_file(files, f"{name}, {files[0].name} ... {files[-1].name}")


def _metric_poses(
    listing: Listing, rows: np.ndarray, unit: str | None, alone: Sequence[str] = ()
) -> tuple[tuple[PoseReading, ...], dict[str, object]]:
    """Return the different readings of the poses, in metres, and how the list was understood."""
    readings: list[PoseReading] = []
    for one in pick(listing.readings, rows):
        if not any(np.abs(one.X - other.X).max() < 1e-9 for other in readings):
            readings.append(one)
    length = listing.unit or unit or unit_by_size(readings[0].X[:, :3, 3])
    metric = tuple(replace(one, X=scaled(one.X, UNITS[length])) for one in readings)
    words: dict[str, object] = {
        "file": listing.name,
        "form": listing.form,
        "unit": length,
        "reading": readings[0].form,
        "rows": len(listing),
        "left_out": [f"row {row + 1}: {why}" for row, why in listing.left_out] + list(alone),
    }
    return metric, words


def profile_unit(found: Profiles, unit: str | None) -> str:
    if found.unit:
        return found.unit
    if unit is not None:
        return unit
    widths = [float(np.ptp(x)) for p in found.points if len(x := p[np.isfinite(p[:, 0]), 0])]
    z = np.concatenate([p[:, 1] for p in found.points])
    far = float(np.nanmedian(np.abs(z))) if np.isfinite(z).any() else 0.0
    return "mm" if max(float(np.median(widths)) if widths else 0.0, far) > _WIDE else "m"
