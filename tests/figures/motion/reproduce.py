"""Repeats the experiments of the second flange paper on a simulated cell: both modes, tracking; with pictures."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from tests.figures.harness import Row, Run, figure
from tests.worlds.motion import Look, MotionOptions, MotionWorld, StaticMode, noise_of_face, write_motion_dataset
from weldcal.calibration.data.motion_dataset import MotionDataset, load_motion_dataset
from weldcal.calibration.flange.fit import FlangeFit, face_cloud
from weldcal.calibration.geometry.se3 import as_transform, exp_rotation, fit_rigid, rotation_vector
from weldcal.calibration.motion.estimate import MotionEstimate, estimate_in_motion
from weldcal.calibration.motion.frames import see_frames
from weldcal.calibration.motion.observed import ObservedFrames
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.calibration.published.algorithm1 import Verification, icp_error, make_verification
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard
from weldcal.tools.console import Progress
from weldcal.tools.report.pictures import GREY, OURS, THEIRS, TRUTH, plain, subplots, svg
from weldcal.tools.report.render import fixed

_COLOURS = (OURS, THEIRS, TRUTH)
COMPONENTS = ("roll", "pitch", "yaw", "x", "y", "z")
_SECONDS = 14.0  # of the history that a reader can still follow


def track_picture(scanner: Array, robot: Array, robot_at_arrival: Array) -> bytes:
    """Draw Fig. 5: the flange's centre (N, 3) m by scanner and robot, at capture and arrival, in x-y and x-z."""
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    for axes, (a, b) in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), strict=True):
        for p, marker, colour, size, label in (
            (robot_at_arrival, "x", GREY, 4, "robot, at arrival"),
            (robot, ".", "#5b7d4e", 7, "robot, at the capture found"),
            (scanner, ".", TRUTH, 3, "scanner"),
        ):
            axes.plot(1e3 * p[:, a], 1e3 * p[:, b], marker, color=colour, ms=size, label=label)
        axes.set_aspect("equal")
        plain(axes, f"{'xyz'[a]}, mm", f"{'xyz'[b]}, mm")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return svg(figure)


def _components(axes: Axes, t: Array, errors: Array, first: int) -> None:
    """Three components over the seconds that a reader can follow: rotation (``first`` 0) or translation (3)."""
    shown = t < t[0] + _SECONDS
    for k in range(3):
        axes.plot(
            t[shown], errors[shown, first + k], ".-", ms=4, lw=0.8, color=_COLOURS[k], label=COMPONENTS[first + k]
        )
    axes.margins(y=0.2)  # the legend lies above the lines
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper right")


def history_picture(
    t: Array,
    before: Array,
    after: Array,
    titles: tuple[str, str] = ("poses at arrival", "joint estimate of X_BC and clock"),
) -> bytes:
    """Draw Fig. 6, or 7 of a link: the error (N, 6) by ICP over time (N,) s, before and after synchronisation."""
    figure, every = subplots(9.0, 6.0, 2, 2, sharex=True, sharey="row")
    for column, (title, errors) in enumerate(zip(titles, (before, after), strict=True)):
        for row, (first, unit) in enumerate(((3, "mm"), (0, "degrees"))):
            axes = every[row, column]
            _components(axes, t, errors, first)
            plain(axes, "time, s" if row else "", unit if not column else "")
            if not row:
                axes.set_title(title, fontsize=10)
    return svg(figure)


def after_picture(t: Array, errors: Array) -> bytes:
    """Return the right half of Fig. 6 in its own scale."""
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    for axes, first, unit in zip(figure.subplots(1, 2), (3, 0), ("mm", "degrees"), strict=True):
        _components(axes, t, errors, first)
        plain(axes, "time, s", unit)
    return svg(figure)


def quality_picture(faces: Mapping[str, Array], titles: Mapping[str, str]) -> bytes:
    """Fig. 9: points (N, 3) mm of the flange in both modes, from the front by height and from the side."""
    figure, every = subplots(9.0, 6.4, 2, 2, height_ratios=[3.0, 1.0], sharex=True)
    for column, (name, points) in enumerate(faces.items()):
        front, side = every[:, column]
        dots = front.scatter(
            points[:, 0], points[:, 1], c=points[:, 2], s=0.6, cmap="viridis", vmin=-1.5, vmax=1.5, rasterized=True
        )
        front.set_aspect("equal")
        front.set_title(titles[name], fontsize=10)
        plain(front, "", "mm")
        front.set(xlim=(-36, 36), ylim=(-36, 36))
        band = np.abs(points[:, 1]) < 2.0
        side.plot(points[band, 0], points[band, 2], ".", ms=1.5, color=OURS, rasterized=True)
        side.set_ylim(-10.0, 4.0)
        plain(side, "mm", "height, mm")
    figure.colorbar(dots, ax=every[0, :].tolist(), label="height over the face, mm", shrink=0.7)
    return svg(figure)


_ICP_FRAMES, _QUICK_FRAMES = 120, 10  # for Table 1 and Fig. 6
_REACH_M = 0.01
_TO_MM = np.array([*[np.degrees(1.0)] * 3, *[1e3] * 3])


@figure("motion", "the flange paper on motion: Table 1, Eq. 21, Fig. 5, 6 and 9; a quick run decides nothing")
def motion(run: Run) -> None:
    """Repeat the paper on a simulated cell; the recording and its truth are kept. 15 minutes in full."""
    found, drawn = compute(run.out, run.seed, not run.full, None, run.progress)
    run.table("Errors by ICP", ("mode", "poses", *(c for c in COMPONENTS if c != "yaw"), "rms, mm"), _table_1(found))
    errors = [(name, *(fixed(v, 3 + (k == "deg")) for k, v in e.items())) for name, e in found["X_BC_error"].items()]
    run.table("Against the truth", ("X_BC from", "at the cube, mm", "at the camera, mm", "rotation, deg"), errors)
    better = [(name, *(fixed(v, 3) for v in e.values())) for name, e in found["compensation_rms_mm"].items()]
    run.table("Compensation (Eq. 21)", ("calibration", "rms before, mm", "rms after, mm"), better)
    quality = [
        (n, str(q["points"]), fixed(q["plane_mm"], 3), fixed(q["edge_mm"], 3)) for n, q in found["quality"].items()
    ]
    header = ("mode", "points on the face", "rms about the plane, mm", "rms of the edge, mm")
    run.table("Quality (Fig. 9)", header, quality)
    tracking = found["tracking_rms_mm"]
    rows = (
        ("tracking while moving, rms mm: before, after", f"{tracking['before']:.3f}, {tracking['after']:.3f}"),
        ("clock offset off, ms: device stamps", fixed(found["clock_offset_error_ms"], 3)),
        ("clock offset off, ms: arrivals only", fixed(found["arrival_offset_error_ms"], 3)),
        ("delay, ms", fixed(found["delay_ms"], 1)),
    )
    run.table("", ("figure", "found"), rows)
    for name, picture in drawn.items():
        run.write(f"{name}.svg", picture)


def compute(
    folder: Path, seed: int, quick: bool, frames: int | None, progress: Progress
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Run the study and write `dataset` with truth.json: its figures, and its pictures by name.

    Errors of X_BC are in mm at the cube's centre and at the camera's origin, and in degrees.
    """
    world = MotionWorld(
        MotionOptions(
            frames=frames or (90 if quick else 600), size=(400, 300) if quick else None, surroundings=False, seed=seed
        )
    )
    recorded, truth_file = folder / "dataset", folder / "truth.json"
    write_motion_dataset(world, recorded, truth_file, lambda stage, f: progress(stage, 0.6 * f))
    data = load_motion_dataset(recorded)
    motion = ContinuousMotion(data.stream)
    seen = see_frames(data, world.flange, motion, seed=seed, tell=lambda f: progress("fits", 0.6 + 0.15 * f))
    observed = seen.observed
    progress("calibration in motion", 0.76)
    found = estimate_in_motion(observed, motion)
    by_arrival = estimate_in_motion(replace(observed, device=None), motion, held_out=False)
    static = StaticMode(world, 630 if quick else None)
    looks = static.grid(seed, lambda stage, f: progress(stage, 0.78 + 0.08 * f))
    X_static = fit_rigid(np.array([k.X_BF.translation() for k in looks]), np.array([k.fit.center_C for k in looks]))
    at_arrival = motion.poses(observed.arrival)
    both = np.isfinite(at_arrival[:, 0, 0]) & found.inliers
    X_raw = fit_rigid(
        at_arrival[both, :3, 3], observed.p_C[both]
    )  # the paper's method in motion: SVD, no synchronisation
    progress("ICP of the flange mesh", 0.88)
    verify = _Verifier(data, seen.fits, world.flange)
    at_capture = motion.poses(found.capture)
    chosen = _spread(np.flatnonzero(both), _QUICK_FRAMES if quick else _ICP_FRAMES)
    before, kept = verify.errors(observed.ids, chosen, at_arrival, X_raw)
    after, kept_after = verify.errors(observed.ids, chosen, at_capture, found.X_BC)
    rows = {
        "static mode, SVD": _static_errors(looks, X_static, world.flange),
        "motion mode, SVD, poses at arrival": before,
        "motion mode, joint estimate": after,
    }
    truth = json.loads(truth_file.read_text(encoding="utf-8"))
    captures = np.array([truth["capture_s"][id] for id in observed.ids])
    offset = found.clock.offset_s
    used = found.inliers
    p_robot, p_arrival = at_capture[:, :3, 3], at_arrival[:, :3, 3]
    t0 = float(observed.arrival[0])
    p_seen = (found.X_BC @ observed.p_C.T).T
    raw_seen = (X_raw @ observed.p_C.T).T
    quality, faces = _quality(world, static, data, observed.ids, seen.fits, found)
    errors = {
        "static, SVD": _X_error(X_static, world),
        "motion, SVD, poses at arrival": _X_error(X_raw, world),
        "motion, synchronised": _X_error(found.X_BC, world),
        "motion, arrivals only": _X_error(by_arrival.X_BC, world),
    }
    both_ways = _compensation(verify, observed.ids, chosen, at_arrival, at_capture, X_raw, found.X_BC)
    t = np.asarray(observed.arrival[kept_after] - t0)
    figures: dict[str, Any] = {
        "table_1": {name: _row(e) for name, e in rows.items()},
        "X_BC_error": errors,
        "clock_offset_ms": float("nan") if offset is None else 1e3 * offset,
        "clock_offset_sigma_ms": None if found.clock.sigma_s is None else 1e3 * found.clock.sigma_s,
        "clock_offset_error_ms": _offset_error(found, observed, captures),
        "clock": found.clock.kind,
        "arrival_offset_error_ms": _offset_error(by_arrival, observed, captures),
        "delay_ms": 1e3 * float(np.mean(observed.arrival - captures)),
        "tracking_rms_mm": {
            "before": _rms(np.linalg.norm(raw_seen[both] - p_arrival[both], axis=1)),
            "after": _rms(found.held_out_m[used]),
        },
        "compensation_rms_mm": both_ways,
        "quality": quality,
        "frames": len(data.frames),
        "frames_seen": len(observed),
    }
    titles = {n: f"{n}: {q['points']} points, {q['plane_mm']:.2f} mm rms" for n, q in quality.items()}
    drawn = {
        "track": track_picture(p_seen[used], p_robot[used], p_arrival[used]),
        "history": history_picture(t, _matching(before, kept, kept_after), after),
        "after": after_picture(t, after),
        "faces": quality_picture(faces, titles),
    }
    return figures, drawn


def _row(errors: Array) -> dict[str, Any]:
    """Return a row of Table 1: ICP errors (N, 6) of the flange mesh at poses, degrees and mm in the flange's axes."""
    return {
        "mean": dict(zip(COMPONENTS, errors.mean(axis=0).tolist(), strict=True)),
        "sd": dict(zip(COMPONENTS, errors.std(axis=0).tolist(), strict=True)),
        "rms_mm": _length_rms(errors),
        "poses": len(errors),
    }


def _length_rms(errors: Array) -> float:
    """Rms length of the displacements of (N, 6) errors, mm."""
    return float(np.sqrt(np.mean((errors[:, 3:] ** 2).sum(axis=1))))


def _table_1(figures: Mapping[str, Any]) -> Iterable[Row]:
    for name, r in figures["table_1"].items():
        cells = (f"{fixed(r['mean'][c])} ± {fixed(r['sd'][c])}" for c in COMPONENTS if c != "yaw")
        yield name, str(r["poses"]), *cells, fixed(r["rms_mm"])


class _Verifier:
    """ICP errors of the flange mesh in frames of a recording."""

    def __init__(self, data: MotionDataset, fits: dict[str, FlangeFit], standard: FlangeStandard) -> None:
        self._data, self._fits, self._standard = data, fits, standard
        self._models: dict[str, Verification] = {}

    def model(self, id: str) -> Verification:
        """Return the face of one frame against the mesh, without the robot's pose."""
        if id not in self._models:
            cloud = face_cloud(self._data.cloud(id), self._fits[id], self._standard)
            self._models[id] = make_verification(cloud, RigidTransform(), self._standard)
        return self._models[id]

    def one(self, id: str, X_BF: Array, X_BC: RigidTransform) -> tuple[Array, RigidTransform | None]:
        """Error (6,) deg and mm, and the correction of Eq. 21, None where the registration failed."""
        # the unsynchronised error, some 30 mm, must be within reach; a search farther than needed takes most of the
        # time
        off = float(np.linalg.norm(X_BC @ self._fits[id].center_C - X_BF[:3, 3]))
        verification = replace(self.model(id), X_BR=as_transform(X_BF), max_distance_m=max(_REACH_M, 2.0 * off))
        found = icp_error(X_BC, verification)
        return np.asarray(found.value * _TO_MM), found.X_CpC

    def errors(
        self, ids: tuple[str, ...], which: NDArray[np.intp], poses: Array, X_BC: RigidTransform
    ) -> tuple[Array, Array]:
        """Errors (N, 6) deg and mm of the frames with a registration, and their indices (N,)."""
        found, kept = [], []
        for k in which:
            value, correction = self.one(ids[k], poses[k], X_BC)
            if correction is not None:
                found.append(value)
                kept.append(int(k))
        return np.array(found).reshape(-1, 6), np.array(kept, dtype=int)


def _static_errors(looks: list[Look], X_BC: RigidTransform, standard: FlangeStandard) -> Array:
    """ICP errors (N, 6) deg and mm at the poses of the grid."""
    out = []
    for look in looks:
        cloud = face_cloud(look.points_C, look.fit, standard)
        out.append(icp_error(X_BC, make_verification(cloud, look.X_BF, standard)).value * _TO_MM)
    return np.array(out)


def _compensation(
    verify: _Verifier,
    ids: tuple[str, ...],
    chosen: NDArray[np.intp],
    at_arrival: Array,
    at_capture: Array,
    X_raw: RigidTransform,
    X_found: RigidTransform,
) -> dict[str, dict[str, float]]:
    """Compute the rms ICP displacement (mm) before and after X_BC is multiplied by the mean error (Eq. 21).

    The matrix comes from every other frame, the errors from the frames between.
    """
    out = {}
    for name, X, poses in (
        ("SVD, poses at arrival", X_raw, at_arrival),
        ("SVD, poses at the capture", X_raw, at_capture),
        ("joint estimate", X_found, at_capture),
    ):
        corrections = [c for _, c in (verify.one(ids[k], poses[k], X) for k in chosen[::2]) if c is not None]
        turn = np.mean([rotation_vector(c.rotation()) for c in corrections], axis=0)
        shift = np.mean([c.translation() for c in corrections], axis=0)
        better = X @ RigidTransform(RotationMatrix(exp_rotation(turn)), shift)
        out[name] = {
            when: _length_rms(verify.errors(ids, chosen[1::2], poses, Y)[0])
            for when, Y in (("before", X), ("after", better))
        }
    return out


def _quality(
    world: MotionWorld,
    static: StaticMode,
    data: MotionDataset,
    ids: tuple[str, ...],
    fits: dict[str, FlangeFit],
    found: MotionEstimate,
) -> tuple[dict[str, dict[str, Any]], dict[str, Array]]:
    """Compare the fastest frame used with a static scan there (Fig. 9); faces (N, 3) mm in the flange's axes."""
    k = int(np.argmax(np.where(found.inliers, found.speed, -np.inf)))
    q = world.joints(float(found.capture[k]) - world.options.robot_start_s)
    still = static.look(q, np.random.default_rng(9))
    quality, faces = {}, {}
    moving = data.cloud(ids[k])
    for name, points, fit in (("static", still.points_C, still.fit), ("in motion", moving, fits[ids[k]])):
        plane, edge, count = noise_of_face(points, fit, world)
        quality[name] = {"points": count, "plane_mm": plane, "edge_mm": edge}
        flat = points.reshape(-1, 3)
        d = flat[np.isfinite(flat[:, 2])] - fit.center_C
        d = d[np.linalg.norm(d, axis=1) < 0.04]
        x = np.cross(fit.normal_C, [0.0, 1.0, 0.0])
        x /= np.linalg.norm(x)
        faces[name] = 1e3 * d @ np.column_stack([x, np.cross(fit.normal_C, x), fit.normal_C])
    return quality, faces


def _X_error(X_BC: RigidTransform, world: MotionWorld) -> dict[str, float]:
    """Error of X_BC: mm at the cube's centre, mm at the camera's origin, degrees."""
    p_C = world.X_BC.inverse() @ world.centre
    turn = (world.X_BC.inverse() @ X_BC).rotation().ToAngleAxis().angle()
    origin = np.linalg.norm(X_BC.translation() - world.X_BC.translation())
    return {
        "at_the_cube_mm": 1e3 * float(np.linalg.norm(X_BC @ p_C - world.centre)),
        "at_the_camera_mm": 1e3 * float(origin),
        "deg": float(np.degrees(turn)),
    }


def _offset_error(found: MotionEstimate, observed: ObservedFrames, captures: Array) -> float:
    """Error of the clock's offset, ms: mean over the frames of the stated capture time less the true one."""
    clock = found.clock
    if clock.offset_s is None:
        return float("nan")
    if clock.kind == "device" and observed.device is not None:
        drift = (clock.drift or 0.0) * (observed.device - (clock.reference_s or 0.0))
        return 1e3 * float(np.mean(observed.device + clock.offset_s + drift - captures))
    return 1e3 * float(np.mean(observed.arrival - clock.offset_s - captures))


def _matching(errors: Array, kept: Array, wanted: Array) -> Array:
    """Rows of ``errors`` (of frames ``kept``) for the frames ``wanted``, NaN where there is none."""
    row = {int(k): e for k, e in zip(kept, errors, strict=True)}
    return np.array([row.get(int(k), np.full(6, np.nan)) for k in wanted])


def _spread(index: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    """At most ``n`` of the indices, evenly spread."""
    return np.asarray(index[np.unique(np.linspace(0, len(index) - 1, min(n, len(index))).astype(int))])


def _rms(values: Array) -> float:
    values = values[np.isfinite(values)]
    return 1e3 * float(np.sqrt(np.mean(values**2)))
