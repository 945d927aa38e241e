"""Pairs poses with clouds: by name, by the number in the name, or in the natural order of the names."""

from collections.abc import Sequence
from pathlib import Path

from weldcal.calibration.data.cloud_files.depth import IMAGES, is_camera_file, may_be_depth
from weldcal.calibration.data.clouds import NO_NOTES, SUFFIXES, cloud_id, ending_of
from weldcal.calibration.data.poses.names import natural, number_of
from weldcal.calibration.errors import DatasetError

FOLDERS = ("clouds", "pointclouds", "point_clouds", "scans", "ply", "pcd", "points", "depth", "depth_images", "images")
_NOTES = ("readme", "notes")
_CLOSED = {".zdf": "Zivid", ".praw": "Photoneo", ".pmraw": "Photoneo", ".dat": "the scanner's maker"}


def find_clouds(folder: Path, poses: Path | tuple[Path, ...]) -> list[Path]:
    """The clouds of a dataset folder in the natural order of their names; files of poses are none.

    Raises:
        DatasetError: there are none, or only in a maker's closed format.
    """
    taken = set(poses) if isinstance(poses, tuple) else {poses}
    places = [folder / name for name in FOLDERS if (folder / name).is_dir()] + [folder]
    for of_place in (_points, _depths):  # depth images only where no place holds points
        for place in places:
            files = [p for p in place.iterdir() if not p.name.startswith((".", "_")) and p not in taken]
            ours = of_place(files)
            if ours:
                # a folder that was copied twice: one ending is enough
                first = next(e for e in SUFFIXES if any(ending_of(p) == e for p in ours))
                return sorted((p for p in ours if ending_of(p) == first), key=lambda p: natural(p.name))
    for place in places:
        closed = sorted(p.name for p in place.iterdir() if p.suffix.lower() in _CLOSED)
        if closed:
            ending = Path(closed[0]).suffix.lower()
            raise DatasetError(
                f"The clouds of '{folder.name}' are {ending} files ({closed[0]}), a closed format that only software of"
                f" {_CLOSED[ending]} reads: export each as .ply or .pcd, or its points as .npy, beside the poses."
            )
    raise DatasetError(
        f"'{folder.name}' has poses but no clouds; put one for each pose into clouds/: .ply, .pcd, .npy, .npz, .xyz,"
        " .pts or .csv, or depth images (.png of 16 bits, .tif, .npy)."
    )


def _points(files: list[Path]) -> list[Path]:
    ours = [p for p in files if ending_of(p) in NO_NOTES]
    return ours or [
        p
        for p in files
        if ending_of(p) in SUFFIXES
        and ending_of(p) not in IMAGES
        and cloud_id(p).lower() not in _NOTES
        and not is_camera_file(p)
    ]


def _depths(files: list[Path]) -> list[Path]:
    return [p for p in files if may_be_depth(p)]


def pair(ids: Sequence[str], n: int, clouds: Sequence[Path], source: str) -> tuple[list[str], list[Path | None], str]:
    """Ids of n poses, the cloud of each (None: it has none) and how they were paired, a phrase.

    ``ids`` is empty where the poses have no names; ``clouds`` are in their natural order.

    Raises:
        DatasetError: names or counts do not go together; the sentence names those without a partner.
    """
    stems = {cloud_id(p): p for p in clouds}
    if len(stems) < len(clouds):
        again = next(p for p in clouds if stems[cloud_id(p)] is not p)
        raise DatasetError(f"Two clouds are called '{cloud_id(again)}'; keep one.")
    if ids and set(ids) & set(stems):
        _no_orphans([p.name for p in clouds if cloud_id(p) not in ids], source)
        return list(ids), [stems.get(i) for i in ids], "paired by name"
    if ids:
        numbers = [number_of(i) for i in ids]
        of = [number_of(cloud_id(p)) for p in clouds]
        if None not in numbers and None not in of and len(set(numbers)) == n and len(set(of)) == len(of):
            by_number = dict(zip(of, clouds, strict=True))
            same = set(numbers) == set(of)
            if same or (len(clouds) != n and set(numbers) & set(of)):
                _no_orphans([p.name for k, p in by_number.items() if k not in numbers], source)
                return list(ids), [by_number.get(k) for k in numbers], "paired by the numbers in their names"
        raise _apart(ids, clouds, source)
    if len(clouds) != n:
        raise DatasetError(
            f"'{source}' holds {n} poses, and there are {len(clouds)} clouds ({clouds[0].name} to {clouds[-1].name});"
            " without names each pose needs its cloud, in the same order: remove what has no partner, or add a column"
            " id with the clouds' names."
        )
    return [cloud_id(p) for p in clouds], list(clouds), f"paired in order, {clouds[0].name} with the first pose"


def _no_orphans(orphans: list[str], source: str) -> None:
    if orphans:
        names = ", ".join(orphans[:5])
        raise DatasetError(
            f"'{source}' has no pose for {names}; add the missing row{'s' if len(orphans) > 1 else ''} or remove the"
            " cloud."
        )


def _apart(ids: Sequence[str], clouds: Sequence[Path], source: str) -> DatasetError:
    return DatasetError(
        f"The names do not go together: '{source}' has {len(ids)} poses, {ids[0]} to {ids[-1]}, and there are"
        f" {len(clouds)} clouds, {clouds[0].name} to {clouds[-1].name}; give each cloud the name, or the number, of its"
        " pose."
    )
