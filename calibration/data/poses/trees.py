"""Find lists of poses in documents and arrays by name: YAML, JSON, XML, npz and MATLAB files."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from weldcal.calibration.data.poses.listing import Listing, listing_of, listing_of_array, looks_like_poses
from weldcal.calibration.data.poses.names import columns_of, natural
from weldcal.calibration.data.poses.storage import array_of
from weldcal.calibration.data.poses.text import joints_rad, table_lists
from weldcal.calibration.errors import DatasetError
from weldcal.models.arrays import Array
from weldcal.models.documents import as_number

_PARTNERS = {
    "rotations": "translations",
    "rotation": "translation",
    "rots": "trans",
    "rot": "trans",
    "rvecs": "tvecs",
    "rvec": "tvec",
    "orientations": "positions",
    "orientation": "position",
    "r": "t",
    "q": "t",
}
_NO_POSES = re.compile(
    r"(?i)^(q|joint.*|img|obj|corners?|imgpoints|objpoints|k|d|dist|.*(camera|intrinsic|projection"
    r"|rectif)\w*matrix|.*(coeffs?|distortion)|covariance.*)$"
)
_JOINTS = re.compile(r"(?i)^(q|.*joints?|.*joint_?(angle|position|value|state)s?(_?(deg|rad))?)$")
_VECTOR = re.compile(r"(?i)(rvec|rotvec|rotation_?vector|axis_?angle|rodrigues)")
_QUATERNION = re.compile(r"(?i)(^q$|quat|rotation|^ori|wxyz|xyzw)")
_POSITION = re.compile(r"(?i)^(.*_)?(position|translation|xyz|pos|trans|tvec|t|p|location)$")


def lists_of_tree(tree: Any, name: str) -> list[Listing]:
    """Return every list of poses of a tree of mappings, lists and arrays; the key path follows the name.

    Joint angles stand for the poses where there are none, and beside one list belong to its rows.

    Raises:
        DatasetError: a node has the form of poses and holds none.
    """
    found = list(_collect(tree, name, ""))
    joints = _joints(tree, name) if len(found) < 2 else None
    if joints is None or (found and len(found[0]) != len(joints[0])):
        return found
    if found:
        return [replace(found[0], joints=joints[0])]
    return [Listing(name=name, numbers=(), joints=joints[0], form=joints[1])]


def _joints(tree: Any, name: str) -> tuple[Array, str] | None:
    """Joint angles (n, 5 to 7) rad under a key of a mapping, or of each of its samples, and a phrase.

    None where there are none.
    """
    node = next((v for v in tree.values() if _is_samples(v)), tree) if isinstance(tree, Mapping) else tree
    keys = node[0] if _is_samples(node) else node if isinstance(node, Mapping) else {}
    for key in (k for k in keys if _JOINTS.match(str(k))):
        q = array_of([one.get(key) for one in node] if _is_samples(node) else node[key])
        if q is not None and q.ndim == 2 and len(q) > 1 and 5 <= q.shape[1] <= 7 and np.isfinite(q).all():
            return joints_rad(q, next(iter(re.findall("(?i)(deg|rad)$", str(key))), "").lower(), name)
    return None


def _is_samples(node: Any) -> bool:
    return isinstance(node, list) and bool(node) and all(isinstance(one, Mapping) for one in node)


def _collect(node: Any, name: str, at: str) -> Iterator[Listing]:
    label = f"{name}, {at.strip('/')}" if at.strip("/") else name
    if isinstance(node, np.ndarray):
        if node.dtype.kind in "fiu" and looks_like_poses(node):
            yield listing_of_array(label, node)
        return
    if isinstance(node, list):
        yield from _of_list(node, name, at, label)
    elif isinstance(node, Mapping):
        yield from _of_mapping(node, name, at, label)


def _of_list(node: list[Any], name: str, at: str, label: str) -> Iterator[Listing]:
    array = array_of(node)
    if (
        array is not None
        and array.ndim in (3, 4)
        and array.shape[1] == 2
        and array.shape[2:] in ((16,), (4, 4), (7,), (6,))
    ):
        for k in range(2):  # pairs without names: the robot's pose and the camera's
            yield listing_of_array(f"{label}, {('robot', 'camera')[k]}", array[:, k])
    elif array is not None:
        if looks_like_poses(array):
            yield listing_of_array(label, array)
    elif node and all(isinstance(item, Mapping) for item in node):
        yield from _of_samples(node, name, at, label)
    elif node and all(
        isinstance(item, list) and len(item) == 2 and all(isinstance(v, Mapping) for v in item) for item in node
    ):
        for k in range(2):
            yield from _of_samples([item[k] for item in node], name, at, f"{label}, {('robot', 'camera')[k]}")
    elif node and all(isinstance(item, list) for item in node):
        raise DatasetError(f"'{label}' is not an array of numbers, each row as long as the others.")


def _of_samples(node: list[Mapping[Any, Any]], name: str, at: str, label: str) -> Iterator[Listing]:
    """The lists of samples: each sample has a pose of every list, as fields or as an array."""
    flat = [_flat(item) for item in node]
    names = list(flat[0])
    short = next((k for k, row in enumerate(flat) if not set(names) <= set(row)), None)
    if short is not None and len(flat) > 1:
        missing = next(n for n in names if n not in flat[short])
        if columns_of(names)[0]:
            raise DatasetError(f"Sample {short + 1} of '{label}' has no '{missing}', and the first has.")
        names = [n for n in names if all(n in row for row in flat)]
    columns, _ = columns_of(names)
    if len(columns) >= 6:
        yield from table_lists(names, np.array([[row[n] for n in names] for row in flat]), label)
    for key in node[0]:
        values = [item.get(key) for item in node]
        if all(isinstance(v, Mapping) for v in values) and not _has_columns(values[0]):
            full = f"{name}, {at.strip('/')}/{key}".replace(", /", ", ")
            yield from _of_samples(values, name, f"{at}/{key}", full)  # type: ignore[arg-type]
        elif not _NO_POSES.match(str(key)):
            poses = _stack(values, f"{name}, {key}", label)
            if poses is not None:
                yield listing_of_array(f"{name}, {key}", poses)
    yield from (one for one, _ in _joined({k: [item.get(k) for item in node] for k in node[0]}, name, at))


def _stack(values: list[Any], name: str, label: str) -> Array | None:
    """Return the poses of samples, (n, 4, 4), (n, 3, 4), (n, 6) or (n, 7); NaN where a sample has none.

    None where most are no poses.

    Raises:
        DatasetError: a sample has other numbers than most.
    """
    arrays = [array_of(v) if isinstance(v, list | np.ndarray) else None for v in values]
    sizes = [a.size for a in arrays if a is not None and a.size in (6, 7, 12, 16)]
    size = max(set(sizes), key=sizes.count) if sizes else 0
    if not size or 2 * sizes.count(size) < len(values):
        return None
    for k, (value, array) in enumerate(zip(values, arrays, strict=True)):
        if value is not None and (array is None or array.size != size):
            raise DatasetError(
                f"Sample {k + 1} of '{label}' is no pose of {size} numbers, as the others of '{name}' are; correct or"
                " remove it."
            )
    shape = (-1, 4) if size in (12, 16) else (-1,)
    return np.stack([np.full(size, np.nan).reshape(shape) if a is None else a.reshape(shape) for a in arrays])


def _has_columns(node: Any) -> bool:
    return isinstance(node, Mapping) and len(columns_of(list(_flat(node)))[0]) >= 6


def _of_mapping(node: Mapping[Any, Any], name: str, at: str, label: str) -> Iterator[Listing]:
    samples = _numbered(node)
    if samples:
        yield from _of_samples(samples, name, at, label)
        return
    flat = _flat(node)
    columns, _ = columns_of(list(flat))
    if len(columns) >= 6 and len({c.prefix for c in columns}) == 1:
        roots = {list(flat)[c.index].partition(".")[0] for c in columns}
        beside = {
            k: v for k, v in node.items() if str(k).lower() not in roots and isinstance(v, Mapping | list | np.ndarray)
        }
        if len(roots) > 1:  # the whole mapping is the pose, but for matrices beside it
            beside = {k: v for k, v in beside.items() if (a := array_of(v)) is not None and a.size in (12, 16)}
            keys = [str(k) for k, v in node.items() if isinstance(v, list) and _flat({k: v})]
            stem = re.sub(
                "_?(r|t|rot|trans)?(vec|rotation|translation|position|orientation)$", "", min(keys, default="")
            )
            label = f"{label}, {stem}" if beside and len(stem) > 1 else label
        yield from table_lists(list(flat), np.array([list(flat.values())]), label)
        node = beside
    used: set[str] = set()
    for listing, joined in _joined(node, name, at):
        used |= joined
        yield listing
    singles: list[tuple[str, Listing]] = []
    for key, value in node.items():
        if str(key) in used or _NO_POSES.match(str(key)):
            continue
        found = list(_collect(value, name, f"{at}/{key}"))
        if len(found) == 1 and len(found[0]) == 1:
            singles.append((str(key), found[0]))
        else:
            yield from found
    yield from _together(singles, name, at)


def _numbered(node: Mapping[Any, Any]) -> list[Mapping[Any, Any]]:
    """Return the samples of a mapping with a numbered key each, such as 0, 1, 2 or frame_0, frame_1.

    Empty where it has none.
    """
    found = {str(k): v for k, v in node.items() if isinstance(v, Mapping) and re.search(r"\d", str(k))}
    if len(found) < 3 or len({_stem(k) for k in found}) > 1 or len(found) < len(node) - 3:
        return []
    keys = sorted(found, key=natural)
    return [found[k] for k in keys] if all(set(found[k]) == set(found[keys[0]]) for k in keys) else []


def _together(singles: list[tuple[str, Listing]], name: str, at: str) -> Iterator[Listing]:
    """Single poses under numbered keys (pose_0, pose_1 ...) as one list each."""
    groups: dict[str, list[tuple[str, Listing]]] = {}
    for key, one in singles:
        groups.setdefault(_stem(key), []).append((key, one))
    for stem, group in groups.items():
        if len(group) == 1 or not re.search(r"\d", group[0][0]):
            yield from (one for _, one in group)
            continue
        group.sort(key=lambda g: natural(g[0]))
        yield stacked(
            [one for _, one in group],
            f"{name}, {at.strip('/')} {stem.strip('_- ')}".replace(",  ", ", "),
            tuple(k for k, _ in group),
        )


def _stem(key: str) -> str:
    """Return a key without its last number."""
    return re.sub(r"\d+(?=\D*$)", "", key)


def stacked(lists: list[Listing], name: str, ids: tuple[str, ...] = ()) -> Listing:
    """One list of lists of one pose each. Raises DatasetError where they are written in different forms."""
    first = lists[0].numbers[0]
    if any(one.numbers[0].kind != first.kind for one in lists):
        raise DatasetError(f"'{name}' holds poses in different forms; write all in one.")
    bad = {k: why for k, one in enumerate(lists) for _, why in one.left_out}
    units = {one.unit for one in lists}
    found = []
    # six numbers may begin with the position or with the rotation
    for k in range(min(len(one.numbers) for one in lists)):
        p = np.concatenate([one.numbers[k].p for one in lists])
        r = np.concatenate([one.numbers[k].r for one in lists])
        p[list(bad)] = np.nan
        found.append(
            listing_of(
                name,
                p,
                r,
                rotation=first.rotation,
                angles=first.angles,
                usual=first.usual,
                vector=first.vector,
                firm=first.firm,
                ids=ids,
                unit=lists[0].unit if len(units) == 1 else "",
                form=lists[0].form,
            )
        )
    left_out = tuple((k, bad.get(k, why)) for k, why in found[0].left_out)
    return replace(found[0], numbers=tuple(n for one in found for n in one.numbers), left_out=left_out)


def _joined(node: Mapping[Any, Any], name: str, at: str) -> Iterator[tuple[Listing, set[str]]]:
    """Rotations and translations that stand under two keys, such as R_gripper2base and t_gripper2base."""
    lower = {str(k).lower(): str(k) for k in node}
    for key in node:
        for word, other in (
            *_PARTNERS.items(),
            ("rot", "pos"),
            ("rotation", "position"),
            ("quaternions", "positions"),
            ("quaternion", "position"),
        ):
            k = str(key).lower()
            if not k.startswith(word) and not k.endswith(word):
                continue
            partner = lower.get(other + k[len(word) :]) if k.startswith(word) else lower.get(k[: -len(word)] + other)
            if partner is None or partner == str(key):
                continue
            found = _rotations_and_positions(
                node[key], node[partner], f"{name}, {(at + '/' + str(key)).strip('/')}", str(key)
            )
            if found is not None:
                yield found, {str(key), partner}
                break


def _rotations_and_positions(R: Any, t: Any, label: str, key: str) -> Listing | None:
    turn, at = (v if isinstance(v, np.ndarray) else array_of(v) if isinstance(v, list) else None for v in (R, t))
    if (
        turn is None
        or at is None
        or at.size == 0
        or at.size % 3
        or turn.dtype.kind not in "fiu"
        or at.dtype.kind not in "fiu"
    ):
        return None
    p = np.asarray(at, dtype=float)
    p = p.T if p.ndim == 2 and p.shape[0] == 3 and p.shape[1] != 3 else p.reshape(-1, 3)
    n = len(p)
    turn = np.asarray(turn, dtype=float)
    if turn.ndim == 3 and turn.shape == (3, 3, n) and n != 3:
        turn = np.moveaxis(turn, 2, 0)
    if turn.size == 9 * n:
        return listing_of(label, p, turn.reshape(n, 3, 3), form="rotations and translations")
    if turn.size == 4 * n:
        q = turn.T if turn.ndim == 2 and turn.shape[0] == 4 and turn.shape[1] != 4 else turn.reshape(n, 4)
        return listing_of(label, p, q, form="quaternions and translations")
    if turn.size == 3 * n:
        v = turn.T if turn.ndim == 2 and turn.shape[0] == 3 and turn.shape[1] != 3 else turn.reshape(n, 3)
        sure = "rotation_vector" if _VECTOR.search(key) or key.lower().startswith(("r_", "r")) else ""
        return listing_of(label, p, v, rotation=sure, form="rotation vectors and translations")
    return None


def _flat(node: Mapping[Any, Any], at: str = "") -> dict[str, float]:
    """Return the numbers of a mapping by dotted name; short lists under telling names are spelled out."""
    out: dict[str, float] = {}
    for key, value in node.items():
        path = f"{at}.{key}".strip(".").lower()
        if isinstance(value, Mapping):
            out |= _axis_angle(value, path) or _flat(value, path)
        elif isinstance(value, list) and len(value) == 1 and isinstance(value[0], Mapping):
            out |= _flat(value[0], path)  # a message with one detection or transform
        elif isinstance(value, int | float) and not isinstance(value, bool):
            out[path] = as_number(value)
        elif isinstance(value, list | np.ndarray):
            numbers = value if isinstance(value, np.ndarray) else array_of(value)
            if numbers is not None and numbers.dtype.kind in "fiu":
                out |= _spelled(path, str(key), np.asarray(numbers, dtype=float).ravel())
        elif isinstance(value, str):
            try:
                out[path] = float(value)
            except ValueError:
                continue
    return out


def _axis_angle(value: Mapping[Any, Any], path: str) -> dict[str, float]:
    """Return an angle about an axis as a rotation vector, an orientation vector under its names; empty for others."""
    if {"x", "y", "z", "th"} <= set(value):
        return {f"{path}.{k if k == 'th' else f'o_{k}'}": as_number(value[k]) for k in ("x", "y", "z", "th")}
    axis, angle = array_of(value.get("axis")) if isinstance(value.get("axis"), list) else None, value.get("angle")
    if axis is None or axis.shape != (3,) or not isinstance(angle, int | float):
        return {}
    size = float(np.linalg.norm(axis))
    parent = f"{path.rpartition('.')[0]}."
    vector = as_number(angle) * axis / (size if size > 0.0 else 1.0)
    return dict(zip((f"{parent}rvec_{a}".lstrip(".") for a in "xyz"), map(float, vector), strict=True))


def _spelled(path: str, key: str, numbers: Array) -> dict[str, float]:
    parent = path.rpartition(".")[0]
    parent = f"{parent}." if parent else ""
    if numbers.size == 3 and _POSITION.match(key):
        return dict(zip((f"{parent}{a}" for a in "xyz"), map(float, numbers), strict=True))
    if numbers.size == 4 and (order := re.search(r"(wxyz|xyzw)", key.lower())):
        return dict(zip((f"{parent}q{a}" for a in order[1]), map(float, numbers), strict=True))
    if numbers.size == 4 and _QUATERNION.search(key):
        return dict(zip((f"{parent}q{k}" for k in range(4)), map(float, numbers), strict=True))
    if numbers.size == 3 and _VECTOR.search(key):
        return dict(zip((f"{parent}rvec_{a}" for a in "xyz"), map(float, numbers), strict=True))
    if numbers.size == 3 and re.search(r"(?i)(rpy)", key):
        return dict(zip((f"{parent}{a}" for a in ("roll", "pitch", "yaw")), map(float, numbers), strict=True))
    if numbers.size == 3 and re.search(r"(?i)(rot|ori|euler|angles?|rxyz)", key):
        return dict(zip((f"{parent}r{a}" for a in "xyz"), map(float, numbers), strict=True))
    return {}
