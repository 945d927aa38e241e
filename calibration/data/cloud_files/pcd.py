"""Reads the points of a PCD file after its header has been checked against the length of its body."""

import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from weldcal.calibration.data.cloud_files.body import (
    CloudError,
    CloudForm,
    check_points,
    cloud_stream,
    column_values,
    text_columns,
)
from weldcal.models.arrays import Array
from weldcal.models.files import expansion_limit

_SIZES = {"I": (1, 2, 4, 8), "U": (1, 2, 4, 8), "F": (4, 8)}
_KINDS = {"I": "i", "U": "u", "F": "f"}
_LONGEST_HEADER = 65536
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


@dataclass(frozen=True, kw_only=True)
class _Header:
    """What the header says: of x, y, z the column (in text) and (offset, type) in a record.

    Bytes and numbers of a record.
    """

    columns: tuple[int, ...]
    fields: tuple[tuple[int, str], ...]
    record: int
    numbers: int
    viewpoint: tuple[float, ...]
    width: int
    height: int
    data: str
    begin: int

    @property
    def points(self) -> int:
        """How many points the header promises."""
        return self.width * self.height


def read_pcd(path: Path, form: CloudForm | None = None) -> Array:
    """Points (N, 3), or (H, W, 3) where the header has more than one row, in the file's unit.

    VIEWPOINT is the pose of the sensor when it took the scan. PCL's documentation does not state the frame of the
    points, and programs differ: PCL's viewer and `transform_from_viewpoint` apply VIEWPOINT to points in the sensor's
    frame. PCL's estimation of normals takes it as the sensor's place among points that were moved already. So VIEWPOINT
    other than identity is refused until ``form.viewpoint`` says which: ``sensor`` (it is not applied) or ``world`` (it
    is undone).

    Raises:
        CloudError: no PCD, a header that contradicts itself or the body's length, coordinates that are missing,
            VIEWPOINT.
        InputError: the file cannot be opened.
    """
    with cloud_stream(path) as (stream, size):
        h = _header(path, stream.read(min(size, _LONGEST_HEADER)))
        check_points(path, h.points, size)
        stream.seek(h.begin)
        if h.data == "ascii":
            points = text_columns(path, stream, list(h.columns), h.numbers, 0, h.points, h.points)
        elif h.data == "binary":
            _check_length(path, h, size - h.begin)
            points = column_values(path, stream.read(h.points * h.record), h.points, h.record, list(h.fields))
        else:
            points = _compressed(path, h, stream, size)
    if len(points) != h.points:
        raise CloudError(
            f"The file {path.name} is damaged: its header promises {h.points} points and {len(points)} are there."
        )
    points = _in_sensor_frame(path, points, h.viewpoint, form or CloudForm())
    return points.reshape(h.height, h.width, 3) if h.height > 1 else points


def _in_sensor_frame(path: Path, points: Array, viewpoint: tuple[float, ...], form: CloudForm) -> Array:
    """Return the points in the frame of the sensor, by VIEWPOINT and what is stated of it.

    VIEWPOINT is tx, ty, tz, qw, qx, qy, qz; empty: identity.
    """
    if not viewpoint or form.viewpoint == "sensor":
        return points
    if form.viewpoint != "world":
        raise CloudError(
            f"{path.name} has the VIEWPOINT {' '.join(f'{v:g}' for v in viewpoint)}, and programs differ in what that"
            " means. If the points are in the sensor's frame, write 'viewpoint: sensor' into dataset.yaml. If VIEWPOINT"
            " has already been applied to the points, write 'viewpoint: world'."
        )
    missing = ~points.any(axis=1)
    wxyz = np.array(viewpoint[3:])
    moved: Array = (points - np.array(viewpoint[:3])) @ RotationMatrix(Quaternion(wxyz / np.linalg.norm(wxyz))).matrix()
    moved[missing] = np.nan
    return moved


def _header(path: Path, begin: bytes) -> _Header:
    if not begin.strip():
        raise CloudError(f"The cloud {path.name} is empty; scan again.")
    found: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in found:
        end = begin.find(b"\n", at)
        if end < 0:
            raise CloudError(f"The file {path.name} is not a PCD file: its header has no DATA line.")
        words, at = begin[at:end].decode("latin-1").split(), end + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYS:
            raise CloudError(
                f"The file {path.name} is not a PCD file: '{' '.join(words)[:60]}' is no line of its header."
            )
        if words[0] in found:
            raise CloudError(f"The file {path.name} is damaged: its header has two {words[0]} lines.")
        found[words[0]] = words[1:]
    names, kinds = found.get("FIELDS", []), found.get("TYPE", [])
    sizes = _whole(path, "SIZE", found.get("SIZE", []))
    counts = _whole(path, "COUNT", found.get("COUNT", ["1"] * len(names)))
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise CloudError(
            f"The file {path.name} is damaged: FIELDS, SIZE, TYPE and COUNT of its header are not as many."
        )
    if any(s not in _SIZES.get(t, ()) for s, t in zip(sizes, kinds, strict=True)):
        raise CloudError(f"The file {path.name} is damaged: SIZE and TYPE of its header do not fit each other.")
    data = " ".join(found["DATA"])
    if data not in ("ascii", "binary", "binary_compressed"):
        raise CloudError(f"The file {path.name} has DATA {data[:40]}; ascii, binary or binary_compressed is read.")
    width, height = _extent(path, found)
    columns, fields = [], []
    for c in "xyz":
        if names.count(c) != 1 or counts[names.index(c)] != 1:
            raise CloudError(f"The header of {path.name} must name {c} once, with COUNT 1; export x, y and z.")
        k = names.index(c)
        columns.append(sum(counts[:k]))
        fields.append(
            (sum(s * n for s, n in zip(sizes[:k], counts[:k], strict=True)), f"<{_KINDS[kinds[k]]}{sizes[k]}")
        )
    record = sum(s * n for s, n in zip(sizes, counts, strict=True))
    return _Header(
        columns=tuple(columns),
        fields=tuple(fields),
        record=record,
        numbers=sum(counts),
        viewpoint=_viewpoint(path, found.get("VIEWPOINT", [])),
        width=width,
        height=height,
        data=data,
        begin=at,
    )


def _viewpoint(path: Path, words: list[str]) -> tuple[float, ...]:
    """Return the seven numbers of VIEWPOINT; empty where it is the identity or not stated."""
    if not words:
        return ()
    try:
        values = tuple(float(w) for w in words)
    except ValueError:
        values = ()
    if len(values) != 7 or not np.isfinite(values).all():
        raise CloudError(f"The file {path.name} is damaged: its VIEWPOINT is no position and quaternion (7 numbers).")
    length = float(np.linalg.norm(values[3:]))
    if not any(values[:3]) and (length == 0.0 or not any(values[4:])):
        return ()
    if abs(length - 1.0) > 1e-3:
        raise CloudError(f"The quaternion of VIEWPOINT in {path.name} has the length {length:.4f}; a rotation needs 1.")
    return values


def _extent(path: Path, found: dict[str, list[str]]) -> tuple[int, int]:
    """Width and height; one row of all POINTS where they are not given."""
    if "POINTS" not in found and not {"WIDTH", "HEIGHT"} <= set(found):
        raise CloudError(f"The file {path.name} is not a PCD file: its header has no POINTS line.")
    numbers = {key: _whole(path, key, found[key], 1)[0] for key in ("POINTS", "WIDTH", "HEIGHT") if key in found}
    points = numbers.get("POINTS", numbers.get("WIDTH", 0) * numbers.get("HEIGHT", 0))
    width, height = numbers.get("WIDTH", points), numbers.get("HEIGHT", 1)
    if width * height != points:
        raise CloudError(
            f"The header of {path.name} contradicts itself: WIDTH {width} times HEIGHT {height} is not POINTS {points}."
        )
    return width, height


def _whole(path: Path, key: str, words: list[str], n: int | None = None) -> list[int]:
    if (n is not None and len(words) != n) or not all(w.isascii() and w.isdecimal() and len(w) < 16 for w in words):
        raise CloudError(
            f"The file {path.name} is damaged: {key} {' '.join(words)[:40]} in its header is no whole number."
        )
    return [int(w) for w in words]


def _check_length(path: Path, h: _Header, there: int) -> None:
    if there < h.points * h.record:
        raise CloudError(
            f"The file {path.name} is truncated: its header promises {h.points} points and {there // h.record} are"
            " there."
        )
    if there > h.points * h.record + 1:  # a last newline is no contradiction
        raise CloudError(
            f"The header of {path.name} promises {h.points} points, and {there - h.points * h.record} bytes more"
            " follow; export it again."
        )


def _compressed(path: Path, h: _Header, stream: BinaryIO, size: int) -> Array:
    """The points of a compressed body, field by field; where both lengths before it are equal, it is stored as it is.

    The two lengths must fit the header and the file.
    """
    lengths = stream.read(8)
    if len(lengths) < 8:
        raise CloudError(f"The file {path.name} is truncated: its body is missing.")
    packed, unpacked = struct.unpack("<II", lengths)
    there = size - stream.tell()
    if packed > there:
        raise CloudError(f"The file {path.name} is truncated: {packed} bytes are promised and {there} are there.")
    if unpacked != h.points * h.record:
        raise CloudError(
            f"The file {path.name} is damaged: its header promises {h.points * h.record} bytes of points and its body"
            f" {unpacked}."
        )
    if unpacked > expansion_limit(size):
        raise CloudError(
            f"The file {path.name} would expand to {1e-6 * unpacked:.0f} MB, too much for a file of its size."
        )

    if packed == unpacked:
        body = np.frombuffer(stream.read(unpacked), np.uint8)
        out = np.empty((h.points, 3))
        for k, (at, kind) in enumerate(h.fields):  # all x, then all y ...
            begin = h.points * at
            out[:, k] = body[begin : begin + h.points * np.dtype(kind).itemsize].view(kind)
        return out
    if path.suffix.lower() != ".gz":
        return _decompressed(path)
    with tempfile.NamedTemporaryFile(suffix=".pcd") as plain:
        stream.seek(0)
        plain.write(stream.read())
        plain.flush()
        return _decompressed(Path(plain.name))


def _decompressed(path: Path) -> Array:
    import open3d as o3d  # slow to import, and only a compressed body needs it

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(path, remove_nan_points=False, remove_infinite_points=False)
    return np.asarray(cloud.points, dtype=float)
