"""Reads scans and poses from ROS recordings (MCAP, ROS 2 .db3, ROS 1 .bag) by the optional package rosbags."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from weldcal.calibration.data.header import PoseForm
from weldcal.calibration.data.poses.names import BASES, FLANGES, whose
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.se3 import angle_of, inverse, mean_pose, pose
from weldcal.models.arms.chain import load_chain
from weldcal.models.arrays import Array
from weldcal.models.files import MOST_POINTS

if TYPE_CHECKING:
    from weldcal.calibration.data.poses.listing import Listing

ENDINGS = (".mcap", ".db3", ".bag")
INSTALL = "pip install 'weldcal[ros]'"
_AROUND_S = 0.25  # over which the arm must have rested at a scan
_REST_M, _REST_RAD = 3e-4, 1e-3
_SAME_M, _SAME_RAD = 1e-3, 3e-3  # scans at poses nearer than this are one
FEWEST_RESTS = 6
"""Rests from which on the poses at rest are taken, else those in motion: a choice, above the ends of a motion."""
_MOST_CLOUDS = 500
_KINDS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}  # sensor_msgs/PointField
_CLOUD, _JOINTS, _TF = "PointCloud2", "JointState", "TFMessage"
_POSES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
# a board or a tag in the names that detectors give their frames (aruco_ros, apriltag_ros, ar_track_alvar, easy_handeye)
_BOARD = re.compile(r"(?i)aruco|marker|april|(?<![a-z])tag(?![a-z])|board|checker|chess|pattern|target|fiducial")


@dataclass(frozen=True, eq=False)
class BagScans:
    """Scans of a recording at rest.

    ``ids``, X_BF (n, 4, 4) in metres, clouds (N, 3) or (H, W, 3) in metres, stamps (n,) s, a phrase on what was read,
    and (id, reason) of those left out.
    """

    ids: tuple[str, ...]
    X: Array
    clouds: tuple[Array, ...]
    times: Array
    read_as: str
    refused: tuple[tuple[str, str], ...]


@dataclass
class _Poses:
    """Streams of a recording by topic: joint angles, stamped poses, and transforms by (parent, child)."""

    joints: dict[str, list[tuple[float, tuple[str, ...], Array]]] = field(default_factory=dict)
    poses: dict[str, list[tuple[float, Array]]] = field(default_factory=dict)
    transforms: dict[tuple[str, str], list[tuple[float, Array]]] = field(default_factory=dict)
    fixed: set[tuple[str, str]] = field(default_factory=set)


def find_bag(folder: Path) -> Path | None:
    """Return the recording of a folder.

    The folder itself where it has ROS 2's metadata.yaml, else its one .mcap, .db3 or .bag file.
    """
    if folder.is_file():
        return folder if folder.suffix.lower() in ENDINGS else None
    if (folder / "metadata.yaml").is_file():
        return folder
    inside = sorted(p for p in folder.iterdir() if p.suffix.lower() in ENDINGS)
    inside += sorted(p.parent for p in folder.glob("*/metadata.yaml"))
    if len(inside) > 1:
        raise DatasetError(f"'{folder.name}' holds {len(inside)} recordings; keep the one to read.")
    return inside[0] if inside else None


def has_clouds(folder: Path) -> bool:
    """Return whether this is a recording with clouds: False of another file or folder, and of poses alone."""
    bag = find_bag(folder)
    if bag is None:
        return False
    with _opened(bag) as reader:
        return any(c.msgtype.endswith(_CLOUD) for c in reader.connections)


def read_bag(path: Path, form: PoseForm, robot: str) -> BagScans:
    """Clouds of a recording with the flange's pose at the stamp of each, of the moments at which the arm rested.

    The poses come from ``form.topic`` where it is given, else from the first of: a topic of PoseStamped, the transforms
    (tf) from base to flange, joint angles with the kinematics of ``robot``. One scan is kept for each pose.

    Raises:
        DatasetError: rosbags is not installed, the file is damaged, or there are no clouds or no poses.
    """
    streams = _Poses()
    clouds: list[tuple[float, Array]] = []
    with _opened(path) as reader:
        kinds = {c.topic: c.msgtype.split("/")[-1] for c in reader.connections}
        topic = _cloud_topic(path, kinds, form)
        for of, message, stamp in _messages(reader, (topic,)):
            if of != topic:
                _collect(streams, of, kinds[of], message, stamp)
                continue
            if len(clouds) == _MOST_CLOUDS:
                raise DatasetError(
                    f"'{path.name}' holds more than {_MOST_CLOUDS} clouds on {topic}; record scans at rest."
                )
            clouds.append((_time(message.header, stamp), _points(path, message)))
    if not clouds:
        raise DatasetError(f"'{path.name}' holds no cloud on {topic}.")
    times, X, said = _flange(path, streams, form, robot)
    return _at_rest(path, clouds, times, X, f"{said} and {topic}")


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a recording; whatever its reader raises becomes a DatasetError."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DatasetError(
            f"'{path.name}' is a ROS recording; to read it, install the package for it: {INSTALL}."
        ) from None
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except DatasetError:
        raise
    except MemoryError:
        raise DatasetError(f"'{path.name}' needs more memory than there is: record fewer scans.") from None
    except Exception as e:  # rosbags raises what its storage and decoders raise
        raise DatasetError(
            f"'{path.name}' cannot be read as a ROS recording: {' '.join(str(e).split())[:200] or type(e).__name__}."
        ) from e


def _messages(reader: Any, topics: tuple[str, ...] = ()) -> Iterator[tuple[str, Any, int]]:
    """Topic, message and arrival (ns) of all poses, joint angles and transforms, and of these topics."""
    known = (*_POSES, _JOINTS, _TF)
    wanted = [c for c in reader.connections if c.topic in topics or c.msgtype.split("/")[-1] in known]
    for connection, stamp, raw in reader.messages(connections=wanted):
        yield connection.topic, reader.deserialize(raw, connection.msgtype), stamp


def lists_of_recording(path: Path, arm: str = "") -> list[Listing]:
    """Every list of stamped poses of a recording, in metres: topics of poses, the flange by tf or joint angles, boards.

    Raises:
        DatasetError: as read_bag; or the recording holds pictures where poses of a board are needed.
    """
    from weldcal.calibration.data.poses.listing import listing_of  # only here: a recording of scans needs no lists

    streams = _Poses()
    with _opened(path) as reader:
        kinds = {c.topic: c.msgtype.split("/")[-1] for c in reader.connections}
        for topic, message, stamp in _messages(reader):
            _collect(streams, topic, kinds[topic], message, stamp)
    found = [
        (_named(topic, "camera") if _BOARD.search(topic) else topic, *_table(rows))
        for topic, rows in streams.poses.items()
    ]
    for (parent, child), rows in streams.transforms.items():
        if len(rows) > 1 and bool(_BOARD.search(child)) != bool(_BOARD.search(parent)):
            found.append((_named(f"tf from {parent} to {child}", "camera"), *_table(rows)))
    flange = _chained(path, streams, PoseForm(), needed=False) if streams.transforms else None
    if flange is not None:
        found.append((_named(flange[2], "robot"), flange[0], flange[1]))
    lists = [
        listing_of(
            name, X[:, :3, 3], X[:, :3, :3], rotation="matrix", firm=True, unit="m", times=t, form="stamped poses"
        )
        for name, t, X in found
    ]
    if flange is None:
        lists += [_joints(path, topic, samples, arm) for topic, samples in streams.joints.items()]
    pictures = [topic for topic, kind in kinds.items() if kind in ("Image", "CompressedImage")]
    if pictures and len(lists) < 2:
        raise DatasetError(
            f"'{path.name}' holds pictures ({pictures[0]}) and no poses of a board. Export them with the robot's poses"
            " into a folder, and name the board with --board."
        )
    return lists


def _joints(path: Path, topic: str, samples: list[tuple[float, tuple[str, ...], Array]], arm: str) -> Listing:
    """Return the list of joint angles of a topic, as poses where the arm is named."""
    from weldcal.calibration.data.poses.listing import Listing  # only here, as above

    rows = sorted(samples, key=lambda sample: sample[0])
    order = _order(path, rows[0][1], load_chain(arm).n if arm else min(6, len(rows[0][1])))
    q, times = np.array([row[2][order] for row in rows]), np.array([row[0] for row in rows])
    name = _named(topic, "robot")
    return Listing(name=name, numbers=(), times=times, joints=q, form=f"joint angles of {topic}").of_arm(arm)


def _named(name: str, who: str) -> str:
    """Return a name that says whose list it is."""
    return name if whose(name) == who else f"{who}: {name}"


def at_rest(robot: Listing, camera: Listing) -> list[Listing] | None:
    """Return the poses of two streams where the arm rested, one pair for each rest; None of fewer than FEWEST_RESTS.

    Of the camera's poses within a rest, the mean rotation and the median position.
    """
    from weldcal.calibration.data.poses.listing import listing_of  # only here, as above

    X, C, t = robot.readings[0].X, camera.readings[0].X, camera.times
    assert robot.times is not None
    assert t is not None
    at, still = _still(robot.times, X, t)
    still &= (t > robot.times[0]) & (t < robot.times[-1])
    rests: list[list[int]] = []
    for k in np.flatnonzero(still).tolist():
        off, turn = _apart(at[rests[-1][0]], at[k]) if rests else (np.inf, np.inf)
        if off <= _SAME_M and turn <= _SAME_RAD:
            rests[-1].append(k)
        else:
            rests.append([k])
    if len(rests) < FEWEST_RESTS:
        return None
    form = f"at rest, {sum(map(len, rests))} of {len(t)} stamps"
    poses = np.array([at[rest[len(rest) // 2]] for rest in rests])
    means = np.array([mean_pose(C[rest]) for rest in rests])
    return [
        listing_of(one.name, Y[:, :3, 3], Y[:, :3, :3], rotation="matrix", firm=True, unit="m", form=form)
        for one, Y in ((robot, poses), (camera, means))
    ]


def _cloud_topic(path: Path, kinds: dict[str, str], form: PoseForm) -> str:
    found = sorted(t for t, kind in kinds.items() if kind == _CLOUD)
    if form.cloud_topic:
        found = [t for t in found if t == form.cloud_topic]
    if len(found) == 1:
        return found[0]
    if not found:
        have = ", ".join(f"{t} ({k})" for t, k in sorted(kinds.items())[:8]) or "nothing"
        raise DatasetError(
            f"'{path.name}' holds no topic of PointCloud2{f' called {form.cloud_topic}' if form.cloud_topic else ''},"
            f" but {have}."
        )
    raise DatasetError(
        f"'{path.name}' holds clouds on {', '.join(found)}; set 'poses: {{cloud_topic: {found[0]}}}' in dataset.yaml."
    )


def _time(header: Any, arrival_ns: int) -> float:
    stamp = float(header.stamp.sec) + 1e-9 * float(getattr(header.stamp, "nanosec", 0))
    return stamp if stamp > 0.0 else 1e-9 * arrival_ns


def _points(path: Path, m: Any) -> Array:
    """Return the points of a PointCloud2, (N, 3) or (H, W, 3), NaN where a pixel has none."""
    fields = {f.name: f for f in m.fields}
    if not {"x", "y", "z"} <= set(fields) or m.is_bigendian or m.height * m.width > MOST_POINTS:
        raise DatasetError(f"A cloud of '{path.name}' has no fields x, y, z that can be read.")
    dtype = np.dtype(
        {
            "names": list("xyz"),
            "formats": [_KINDS[fields[a].datatype] for a in "xyz"],
            "offsets": [fields[a].offset for a in "xyz"],
            "itemsize": m.point_step,
        }
    )
    data = np.ascontiguousarray(np.frombuffer(m.data, np.uint8)).reshape(m.height, m.row_step)[
        :, : m.width * m.point_step
    ]
    cells = np.ascontiguousarray(data).view(dtype)
    xyz = np.stack([cells[a].astype(float) for a in "xyz"], axis=-1)
    xyz[~np.isfinite(xyz).all(axis=-1) | (np.abs(xyz).sum(axis=-1) == 0.0)] = np.nan
    if m.height == 1:
        return np.asarray(xyz[0][np.isfinite(xyz[0]).all(axis=1)])
    return np.asarray(xyz)


def _collect(streams: _Poses, topic: str, kind: str, m: Any, arrival_ns: int) -> None:
    if kind == _JOINTS:
        streams.joints.setdefault(topic, []).append(
            (_time(m.header, arrival_ns), tuple(m.name), np.asarray(m.position, dtype=float))
        )
    elif kind in _POSES:
        at = getattr(m, "pose", None)
        at = getattr(at, "pose", at)
        place = (m.transform.translation, m.transform.rotation) if at is None else (at.position, at.orientation)
        streams.poses.setdefault(topic, []).append((_time(m.header, arrival_ns), _pose(*place)))
    else:
        for t in m.transforms:
            edge = (t.header.frame_id.strip("/"), t.child_frame_id.strip("/"))
            streams.transforms.setdefault(edge, []).append(
                (_time(t.header, arrival_ns), _pose(t.transform.translation, t.transform.rotation))
            )
            if topic.endswith("tf_static"):
                streams.fixed.add(edge)


def _pose(p: Any, q: Any) -> Array:
    return pose(np.asarray(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()), np.array([p.x, p.y, p.z]))


def _flange(path: Path, s: _Poses, form: PoseForm, robot: str) -> tuple[Array, Array, str]:
    """Times (n,) s and poses X_BF (n, 4, 4) of the flange, and where they come from."""
    known = (*s.poses, *s.joints)
    if form.topic and form.topic not in (*known, "/tf", "tf"):
        raise DatasetError(
            f"'{path.name}' has no poses on {form.topic}; it has"
            f" {', '.join(known) or 'none'}{' and tf' if s.transforms else ''}."
        )
    stamped = [t for t in s.poses if form.topic in ("", t)]
    if len(stamped) > 1:
        raise DatasetError(
            f"'{path.name}' has poses on {', '.join(stamped)}; set 'poses: {{topic: {stamped[0]}}}' in dataset.yaml."
        )
    if stamped:
        times, X = _table(s.poses[stamped[0]])
        return times, X, stamped[0]
    if s.transforms and form.topic in ("", "/tf", "tf"):
        chained = _chained(path, s, form, needed=not s.joints)
        if chained is not None:
            return chained
    angles = [t for t in s.joints if form.topic in ("", t)]
    if len(angles) == 1:
        found = _joints(path, angles[0], s.joints[angles[0]], robot)
        X = found.readings[0].X
        return np.asarray(found.times), X, found.form
    raise DatasetError(
        f"'{path.name}' holds no poses of the flange: neither PoseStamped, nor tf from base to flange, nor JointState."
    )


def _order(path: Path, names: tuple[str, ...], n: int) -> list[int]:
    """Positions of the arm's joints among the names, from the base to the flange.

    A UR's driver sorts them by the alphabet.
    """
    ur = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    found = [next((k for k, name in enumerate(names) if part in name), -1) for part in ur]
    if n == 6 and min(found) >= 0:
        return found
    if len(names) < n:
        raise DatasetError(f"'{path.name}' has {len(names)} joint angles a message, and the arm has {n} joints.")
    return list(range(n))


def _table(rows: list[tuple[float, Array]]) -> tuple[Array, Array]:
    rows = sorted(rows, key=lambda r: r[0])
    times = np.array([t for t, _ in rows])
    keep = np.concatenate([[True], np.diff(times) > 0.0])
    return times[keep], np.array([X for _, X in rows])[keep]


def _chained(path: Path, s: _Poses, form: PoseForm, *, needed: bool) -> tuple[Array, Array, str] | None:
    """Return the flange in the base along the tree of transforms."""
    parent = {child: above for above, child in s.transforms}
    frames = {*parent, *parent.values()}
    flange = form.flange_frame or next((f for f in FLANGES if f in parent), "")
    chain: list[tuple[str, str]] = []
    up = flange
    while up in parent and len(chain) <= len(parent):
        chain.append((parent[up], up))
        up = parent[up]
    above = [p for p, _ in chain]
    base = form.base_frame or next((b for b in BASES if b in above or b in frames), above[-1] if above else "")
    extra: Array = np.eye(4)
    if base not in above and base in parent and parent[base] in above:  # ROS hangs a UR's `base` beside its links
        edge = (parent[base], base)
        extra, base_above = inverse(s.transforms[edge][-1][1]), parent[base]
    else:
        base_above = base
    if not chain or base_above not in above:
        if not needed:
            return None
        raise DatasetError(
            f"The transforms of '{path.name}' lead from no base to the flange (frames:"
            f" {', '.join(sorted(frames)[:10])}); set poses.base_frame and poses.flange_frame in dataset.yaml."
        )
    chain = chain[: above.index(base_above) + 1]
    moving = [e for e in chain if e not in s.fixed and len(s.transforms[e]) > 1]
    clock = max((_table(s.transforms[e])[0] for e in moving), key=len, default=None)
    if clock is None:
        raise DatasetError(
            f"The transforms of '{path.name}' from {base} to {flange} never change: record /tf while the arm goes from"
            " pose to pose."
        )
    X = np.broadcast_to(extra, (len(clock), 4, 4))
    for edge in reversed(chain):
        times, link = _table(s.transforms[edge])
        X = X @ (np.broadcast_to(link[-1], (len(clock), 4, 4)) if edge not in moving else _at(times, link, clock))
    return clock, X, f"tf from {base} to {flange}"


def _at(times: Array, X: Array, when: Array) -> Array:
    """Poses interpolated at times (n,), held beyond the ends."""
    if len(times) == 1:
        return np.repeat(X, len(when), axis=0)
    t = np.clip(when, times[0], times[-1])
    p = np.stack([np.interp(t, times, X[:, k, 3]) for k in range(3)], axis=1)
    return pose(np.asarray(Slerp(times, Rotation.from_matrix(X[:, :3, :3]))(t).as_matrix()), p)


def _at_rest(path: Path, clouds: list[tuple[float, Array]], times: Array, X: Array, said: str) -> BagScans:
    """Return the scans at which the arm rested, one for each pose."""
    kept: list[tuple[str, Array, Array, float]] = []
    refused: list[tuple[str, str]] = []
    digits = len(str(len(clouds)))
    at, still = _still(times, X, np.array([t for t, _ in clouds]))
    for k, (t, points) in enumerate(clouds, start=1):
        id = f"scan{k:0{max(2, digits)}d}"
        if not times[0] - _AROUND_S <= t <= times[-1] + _AROUND_S:
            late = min(abs(t - times[0]), abs(t - times[-1]))
            refused.append((id, f"It was taken {late:.1f} s before or after the poses were recorded."))
            continue
        if not still[k - 1]:
            refused.append((id, "The arm moved while it was taken."))
            continue
        if any(d <= _SAME_M and a <= _SAME_RAD for d, a in (_apart(at[k - 1], other) for _, other, _, _ in kept)):
            refused.append((id, "It was taken at the same pose as an earlier one; it counts once."))
            continue
        kept.append((id, at[k - 1], points, t))
    if not kept:
        raise DatasetError(f"'{path.name}' has no scan taken at rest: {refused[0][0]}: {refused[0][1]}")
    return BagScans(
        tuple(k[0] for k in kept),
        np.array([k[1] for k in kept]),
        tuple(k[2] for k in kept),
        np.array([k[3] for k in kept]),
        said,
        tuple(refused),
    )


def _still(times: Array, X: Array, when: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Poses (n, 4, 4) at times (n,) s, and whether the arm rested about each."""
    at = _at(times, X, when)
    still = np.ones(len(when), dtype=bool)
    for one in (_at(times, X, when - _AROUND_S), _at(times, X, when + _AROUND_S)):
        still &= np.linalg.norm(one[:, :3, 3] - at[:, :3, 3], axis=1) <= _REST_M
        still &= angle_of(np.swapaxes(one[:, :3, :3], 1, 2) @ at[:, :3, :3]) <= _REST_RAD
    return at, still


def _apart(A: Array, B: Array) -> tuple[float, float]:
    return float(np.linalg.norm(A[:3, 3] - B[:3, 3])), float(angle_of(A[:3, :3].T @ B[:3, :3]))
