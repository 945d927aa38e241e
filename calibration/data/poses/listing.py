"""A list of poses as a file holds it: its numbers, the names and times of its rows, and the rows without a pose."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.readings import PoseNumbers, PoseReading, parse_form, readings
from weldcal.calibration.errors import DatasetError
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.kinematics import chain_poses
from weldcal.models.arrays import Array
from weldcal.models.files import LARGEST_NUMBER, MOST_POSES

_ORTHONORMAL = 0.05  # rotations with two decimals deviate by 0.02 at most
_UNIT_LENGTH = 0.05  # of quaternions with two decimals
_MATRIX, _QUATERNION, _VECTOR = range(3)


@dataclass(frozen=True, eq=False, kw_only=True)
class Listing:
    """One list of n poses, not yet read.

    Attributes:
        name: the file, with the key or the label of the list where it holds more than one.
        numbers: the possible meanings of its numbers, the usual one first.
        ids: names of the rows, (n) or empty.
        times: times of the rows (n) s, or None.
        unit: the unit of length that the file states, or empty.
        form: a phrase for the reader, such as "UR pose vectors".
        left_out: rows (from 0) that hold no pose, with the reason.
        joints: joint angles (n, joints) rad, or None; without ``numbers`` they stand for the poses.
    """

    name: str
    numbers: tuple[PoseNumbers, ...]
    ids: tuple[str, ...] = ()
    times: Array | None = None
    unit: str = ""
    form: str = ""
    left_out: tuple[tuple[int, str], ...] = ()
    joints: Array | None = None

    def __len__(self) -> int:
        return len(self.numbers[0].p) if self.numbers or self.joints is None else len(self.joints)

    @cached_property
    def readings(self) -> tuple[PoseReading, ...]:
        """All readings of the list, the usual one first; rows that are left out are identities.

        Raises:
            DatasetError: the numbers contradict what is stated, with the position before and after the rotation.
        """
        found: list[PoseReading] = []
        problem: DatasetError | None = None
        if not self.numbers:
            raise DatasetError(
                f"'{self.name}' holds joint angles and no poses: name the arm by --robot or in dataset.yaml, such as"
                " ur10e or my_arm.urdf. Or write the flange's poses as columns x,y,z,qw,qx,qy,qz."
            )
        for one in self.numbers:
            try:
                found += readings(one)
            except DatasetError as why:
                problem = problem or why
        if problem is not None and not found:
            raise problem
        return tuple(found)

    @property
    def good(self) -> Array:
        """Rows (n) that hold a pose."""
        out = np.ones(len(self), dtype=bool)
        out[[row for row, _ in self.left_out]] = False
        return out

    def stated(self, form: PoseForm, option: str) -> "Listing":
        """Return the list with what dataset.yaml or an option states of its form.

        Raises DatasetError where the numbers contradict it.
        """
        rotation, angles, changes = parse_form(form.rotation, option) if form.rotation else ("", "", ())
        angles = form.angles or angles
        if form.frame == "base_in_flange":
            changes = (*changes, "inverse")
        if angles not in ("", "deg", "rad"):
            raise DatasetError(f"{option} states the angles in '{angles[:20]}'; use deg or rad.")
        if not (rotation or angles or changes) or not self.numbers:
            return self
        numbers = tuple(
            replace(one, rotation=rotation or one.rotation, angles=angles or one.angles, changes=changes)
            for one in self.numbers
            if not rotation or _fits(one, rotation)
        )
        if not numbers:
            held = {"matrix": "matrices", "quaternion": "quaternions", "vector": "three numbers a rotation"}[
                self.numbers[0].kind
            ]
            raise DatasetError(f"'{self.name}' holds {held}, and {option} states {rotation}; correct one of them.")
        return replace(self, numbers=numbers)

    def row(self, k: int) -> "Listing":
        """Return the list of one row alone, named after it."""
        numbers = tuple(replace(one, p=one.p[k : k + 1], r=one.r[k : k + 1]) for one in self.numbers)
        left_out = tuple((0, why) for row, why in self.left_out if row == k)
        name = f"{self.name.partition(',')[0]}, {self.ids[k]}"
        return replace(self, name=name, numbers=numbers, ids=(self.ids[k],), times=None, left_out=left_out, joints=None)

    def of_joints(self) -> "Listing":
        """Return the list of its joint angles alone, which stand for the robot's poses."""
        name = f"{self.name.partition(',')[0]}, joints"
        return replace(self, name=name, numbers=(), form="joint angles", left_out=())

    def of_arm(self, arm: str | None) -> "Listing":
        """Return the list with the flange's poses of an arm where it holds joint angles alone.

        Raises DatasetError where the arm has another number of joints.
        """
        if self.numbers or self.joints is None or not arm:
            return self
        chain = load_chain(arm)
        if self.joints.shape[1] != chain.n:
            raise DatasetError(
                f"'{self.name}' holds {self.joints.shape[1]} joint angles a row, and {chain.name} has {chain.n} joints:"
                " name the arm that was moved with --robot."
            )
        X = chain_poses(chain, self.joints)
        form = f"{self.form} with the kinematics of {chain.name}"
        found = listing_of(self.name, X[:, :3, 3], X[:, :3, :3], unit="m", form=form, ids=self.ids, times=self.times)
        return replace(found, joints=self.joints)


def _fits(numbers: PoseNumbers, rotation: str) -> bool:
    kind = "quaternion" if rotation.startswith("quaternion") else "matrix" if rotation == "matrix" else "vector"
    return numbers.kind == kind


def listing_of(
    name: str,
    p: Array,
    r: Array,
    *,
    rotation: str = "",
    angles: str = "",
    usual: str = "",
    vector: bool = True,
    firm: bool = False,
    **more: object,
) -> Listing:
    """A list of positions (n, 3) and rotations (n, 3), (n, 4) or (n, 3, 3); rows without a pose are found and replaced.

    Raises:
        DatasetError: no row holds a pose, or a number is too large.
    """
    found = _listing(
        name, [(np.asarray(p, dtype=float), np.asarray(r, dtype=float))], rotation, angles, usual, vector, **more
    )
    return replace(found, numbers=tuple(replace(one, firm=firm) for one in found.numbers)) if firm else found


def listing_of_array(name: str, values: Array, **more: object) -> Listing:
    """Return a list of an array of a usual shape.

    (4, 4), (3, 4), (n, 4, 4), (n, 3, 4), (4, 4, n), (4 n, 4), (n, 16), (n, 12), (n, 6), (n, 7), each also with a column
    of times before it, and (6, n), (7, n).

    Raises:
        DatasetError: another shape, or no rigid poses.
    """
    v = np.asarray(values, dtype=float)
    if v.size == 0:
        raise DatasetError(f"'{name}' holds no poses.")
    found = list(_meanings(v))
    if not found:
        shape = " x ".join(map(str, v.shape))
        if v.shape[-1] in (12, 16) or v.shape[-2:] in ((4, 4), (3, 4)):
            raise DatasetError(
                f"'{name}' holds {shape} numbers, and most of its matrices are no rigid pose: the columns of the 3 x 3"
                " part must have length 1 and be at right angles."
            )
        raise DatasetError(
            f"'{name}' holds {shape} numbers, which is no list of poses: 6 (x,y,z,rx,ry,rz), 7 (x,y,z and a quaternion)"
            " or 16 (a 4 x 4 matrix) a pose."
        )
    least = min(kind for kind, *_ in found)
    chosen = [(p, r) for kind, p, r, _ in found if kind == least]
    times = next((t for kind, _, _, t in found if kind == least and t is not None), None)
    if times is not None and more.get("times") is None:
        more["times"] = times
    whole = v.size % 16 == 0 and v.shape[-1] in (4, 16) and not v.reshape(-1, 16)[:, 12:].any()
    form = {
        _MATRIX: "4 x 4 matrices" + (" whose last row 0, 0, 0, 0 is taken as 0, 0, 0, 1" if whole else ""),
        _QUATERNION: "x, y, z, quaternion",
        _VECTOR: "x, y, z and three numbers of a rotation",
    }[least]
    return _listing(name, chosen, "", "", "", True, **({"form": form} | more))


def looks_like_poses(values: Array) -> bool:
    """Return whether an array has a shape and numbers that only poses have."""
    v = np.asarray(values, dtype=float)
    kinds = [kind for kind, *_ in _meanings(v)] if v.size else []
    return bool(kinds) and (
        min(kinds) < _VECTOR or v.shape[-1] == 6 or v.shape == (6, 1) or (v.ndim == 2 and v.shape[0] == 6)
    )


def _meanings(v: Array) -> Iterator[tuple[int, Array, Array, Array | None]]:
    """Kind, positions, rotations and times of every meaning of an array that its numbers allow."""
    if v.ndim == 3 and v.shape[1] == 1:
        v = v[:, 0, :]
    if v.ndim == 1:
        v = v[None]
    if v.ndim == 3:
        for M in (v, np.moveaxis(v, 2, 0)):
            if M.shape[1:] in ((4, 4), (3, 4)):
                yield from _of_matrices(M)
        return
    if v.ndim != 2:
        return
    if v.shape[1] == 4 and len(v) % 4 == 0:
        yield from _of_matrices(v.reshape(-1, 4, 4))
    if v.shape == (3, 4):
        yield from _of_matrices(v[None])
    for table, n in ((v, v.shape[1]), (v.T, v.shape[0])):
        for first in (0, 1):
            times = table[:, 0] if first else None
            rest = table[:, first:]
            if n - first in (12, 16) and (not first or len(table) > 1):
                for kind, p, r, _ in _of_rows(rest):
                    yield kind, p, r, times
            elif n - first == 7:
                for p, q in ((rest[:, :3], rest[:, 3:]), (rest[:, 4:], rest[:, :4])):
                    if _unit(q):
                        yield _QUATERNION, p, q, times
            elif n - first == 6 and (not first or _rising(table[:, 0])):
                yield _VECTOR, rest[:, :3], rest[:, 3:], times
                yield _VECTOR, rest[:, 3:], rest[:, :3], times


def _rising(t: Array) -> bool:
    return len(t) > 1 and bool((np.diff(t) > 0.0).all())


def _of_rows(rows: Array) -> Iterator[tuple[int, Array, Array, None]]:
    yield from _of_matrices(rows.reshape(len(rows), -1, 4))
    if rows.shape[1] == 12:
        R = rows[:, :9].reshape(-1, 3, 3)
        if _orthonormal(R):
            yield _MATRIX, rows[:, 9:], R, None


def _of_matrices(M: Array) -> Iterator[tuple[int, Array, Array, None]]:
    """Matrices row by row, or column by column, whichever has the row 0, 0, 0, 1."""
    filled = M[np.isfinite(M).all(axis=(1, 2)) & (np.abs(M[:, :3, :3]).max(axis=(1, 2)) > 0.0)]
    if M.shape[1:] == (4, 4) and len(filled):
        last = np.array([0.0, 0.0, 0.0, 1.0])
        if not filled[:, 3].any():  # np.zeros((4, 4)) whose last row was forgotten
            last = np.zeros(4)
        if not (np.abs(filled[:, 3] - last) <= 1e-6).all():
            if not (np.abs(filled[:, :, 3] - last) <= 1e-6).all():
                return
            M = np.swapaxes(M, 1, 2)
    R = M[:, :3, :3]
    if _orthonormal(R):
        yield _MATRIX, M[:, :3, 3], R, None


def _orthonormal(R: Array) -> bool:
    R = R[np.isfinite(R).all(axis=(1, 2)) & (np.abs(R).max(axis=(1, 2)) > 0.0)]
    R = np.clip(R, -10.0, 10.0)  # the squares of larger numbers may overflow, and are none of a rotation either
    return (
        bool(len(R)) and float(np.median(np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2)))) <= _ORTHONORMAL
    )


def _unit(q: Array) -> bool:
    length = np.linalg.norm(q, axis=1)
    length = length[np.isfinite(length) & (length > 0.0)]
    return bool(len(length)) and float(np.median(np.abs(length - 1.0))) <= _UNIT_LENGTH


def require_pose(lists: list[Listing]) -> list[Listing]:
    """Return the lists.

    Raises DatasetError where one pose alone is missing: it may be one of many files, and is left out there.
    """
    for one in lists:
        if len(one.left_out) == len(one):
            raise DatasetError(f"'{one.name}' holds no pose: {one.left_out[0][1]}")
    return lists


def _listing(
    name: str,
    meanings: Sequence[tuple[Array, Array]],
    rotation: str,
    angles: str,
    usual: str,
    vector: bool,
    **more: object,
) -> Listing:
    n = len(meanings[0][0])
    if n > MOST_POSES:
        raise DatasetError(
            f"'{name}' holds {n:,} poses, and at most {MOST_POSES:,} are read. Keep one for each scan or picture: the"
            " pose at its time."
        )
    left_out = _without_pose(meanings)
    if len(left_out) == n > 1:
        raise DatasetError(f"'{name}' holds no pose: {left_out[0][1]}")
    rows = [row for row, _ in left_out]
    numbers = []
    for p, r in meanings:
        p, r = p.copy(), r.copy()
        p[rows] = 0.0
        r[rows] = np.eye(3) if r.ndim == 3 else [1.0, 0.0, 0.0, 0.0] if r.shape[1] == 4 else 0.0
        if float(max(np.abs(p).max(), np.abs(r).max())) > LARGEST_NUMBER:
            raise DatasetError(f"'{name}' holds numbers beyond {LARGEST_NUMBER:g}.")
        numbers.append(PoseNumbers(source=name, p=p, r=r, rotation=rotation, angles=angles, usual=usual, vector=vector))
    return Listing(name=name, numbers=tuple(numbers), left_out=tuple(left_out), **more)  # type: ignore[arg-type]


def _without_pose(meanings: Sequence[tuple[Array, Array]]) -> list[tuple[int, str]]:
    """Rows that hold no pose.

    A number is missing, the rotation is zero, or both are those of no motion (a failed detection).
    """
    p, r = meanings[0]
    flat = np.concatenate([p, r.reshape(len(r), -1)], axis=1)
    missing = ~np.isfinite(flat).all(axis=1)
    empty = (
        np.abs(r.reshape(len(r), -1)).max(axis=1) == 0.0
        if r.ndim == 3 or r.shape[1] == 4
        else np.abs(flat).max(axis=1) == 0.0
    )
    still = np.abs(p).max(axis=1) == 0.0
    if r.ndim == 3:
        still &= (r == np.eye(3)).all(axis=(1, 2))
    elif r.shape[1] == 4:
        still &= (np.sort(np.abs(r), axis=1) == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
    else:
        still &= (r == 0.0).all(axis=1)
    found = []
    for k in range(len(p)):
        if missing[k]:
            found.append((k, "A number is missing or not finite."))
        elif empty[k] or still[k]:
            found.append((k, "The pose is zero or the identity: nothing was detected."))
    return found
