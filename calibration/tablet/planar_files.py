"""Read planar touches from an npz file: one visit or many of one rig, with optional queries that no fit uses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from weldcal.calibration.errors import EqualRotations, TabletDataError, TooFewLandmarks
from weldcal.calibration.tablet.plane_pose import tablet_pose
from weldcal.calibration.tablet.touches import MIN_LANDMARKS, TabletTouches, check_page_match
from weldcal.models.array_files import read_npz
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.files import LARGEST_NUMBER

# keys of the file and their dimensions for one visit; one more in front where visits differ in it
DIMENSIONS = {
    "uv": 2,
    "depth": 1,
    "hand": 2,
    "theta_deg": 1,
    "delta_px": 2,
    "tablet_px": 2,
    "mm_per_px": 0,
    "f": 0,
    "c": 1,
    "hand_capture": 1,
}
QUERY_DIMENSIONS = {"uv_q": 2, "theta_q": 1, "hand_q": 2}
ROWS = ("uv", "hand", "theta_deg", "delta_px", "tablet_px")
STEPS_MM = (1.0, 0.5)
_LEAST_READINGS = (
    8  # numbers that must all be whole steps, so that it is no accident: of 1 mm read to 0.1 mm, 1 in 10^8
)


@dataclass(frozen=True)
class Queries:
    """Hold points of the tablet that are in the images but not used.

    Pixel (q, 2), turn (q,) rad and the hand (q, 2) m that touches them.
    """

    uv_px: Array
    theta_rad: Array
    hand_m: Array


@dataclass(frozen=True)
class PlanarVisit:
    """One visit with its touches, and its queries where it has any.

    Besides: the rows of its landmarks in the file, and the rows excluded.
    """

    name: str
    touches: TabletTouches
    queries: Queries | None = None
    rows: tuple[int, ...] = ()
    excluded: tuple[int, ...] = ()


@dataclass(frozen=True)
class PlanarFile:
    """The visits of a file, and the names and reasons of those that are too poor."""

    visits: tuple[PlanarVisit, ...]
    refused: tuple[tuple[str, str], ...] = ()


def load_planar(path: Path) -> PlanarFile:
    """Visits from an npz.

    Uv (n, 2) px, depth (n) mm, hand (n, 2) mm, theta_deg (n), delta_px (n, 2), tablet_px (n, 2), mm_per_px, f (px; one
    number or two), c (2) px, hand_capture (3) mm; optionally uv_q (q, 2), theta_q (q) rad, hand_q (q, 2) mm. Where uv
    is (m, n, 2) there are m visits, and every other key may have that dimension in front, too.

    A landmark with a value that is not a number is excluded; a depth that is missing (or the key) is the tablet's plane
    by PnP. Raises TabletDataError: unreadable, a key missing, a shape that does not fit; and what refuses a visit where
    none is left: TooFewLandmarks, CollinearLandmarks, EqualRotations (radians for degrees), LandmarksNotFound.
    """
    d = _read(path)
    if d["uv"].ndim not in (2, 3) or d["uv"].shape[-1] != 2:
        raise TabletDataError(
            f"'{path.name}': uv must have the shape (n, 2), or (m, n, 2) for m visits, not {d['uv'].shape}."
        )
    if d["uv"].ndim == 2:
        return PlanarFile((_visit("", d, path),))
    m = len(d["uv"])
    if m == 0:
        raise TabletDataError(f"'{path.name}' holds no visit: uv has the shape {d['uv'].shape}.")
    each = [{key: _of_visit(key, v, k, m, path) for key, v in d.items()} for k in range(m)]
    visits, refused = [], []
    for k, own in enumerate(each):
        try:
            visits.append(_visit(str(k), own, path))
        except WeldcalError as problem:
            if k + 1 == m and not visits:
                raise
            refused.append((str(k), str(problem)))
    return PlanarFile(tuple(visits), tuple(refused))


def hand_step_m(visits: tuple[PlanarVisit, ...]) -> float:
    """Return the step (m) to which hands were rounded when they were read off.

    5, 2, 1 or 0.5 mm, or 0 where they are finer.
    """
    mm = 1e3 * np.concatenate([v.touches.hand_m.ravel() for v in visits])
    if mm.size < _LEAST_READINGS:
        return 0.0
    return next((1e-3 * s for s in STEPS_MM if np.abs(mm / s - np.round(mm / s)).max() < 1e-6), 0.0)


def _read(path: Path) -> dict[str, Array]:
    wanted = {**DIMENSIONS, **QUERY_DIMENSIONS}
    try:
        d = {key: np.asarray(value, dtype=float) for key, value in read_npz(path, tuple(wanted)).items()}
    except InputError as error:
        raise TabletDataError(str(error)) from error
    except ValueError as error:
        raise TabletDataError(f"'{path.name}' is not an npz file of numbers.") from error
    for key, value in d.items():
        if float(np.max(np.abs(value[np.isfinite(value)]), initial=0.0)) > LARGEST_NUMBER:
            raise TabletDataError(f"'{path.name}': {key} holds a number beyond {LARGEST_NUMBER:g}.")
    missing = [key for key in DIMENSIONS if key not in d and key != "depth"]
    d.setdefault("depth", np.full(d["uv"].shape[:-1], np.nan) if "uv" in d else np.zeros(0))
    if missing:
        raise TabletDataError(f"'{path.name}' lacks {', '.join(missing)}; docs/tablet.md lists what it must hold.")
    queries = [key for key in QUERY_DIMENSIONS if key in d]
    if queries and len(queries) < len(QUERY_DIMENSIONS):
        lacking = ", ".join(key for key in QUERY_DIMENSIONS if key not in d)
        raise TabletDataError(
            f"'{path.name}' holds {', '.join(queries)} but lacks {lacking}: give all of them, or none."
        )
    return d


def _of_visit(key: str, value: Array, k: int, m: int, path: Path) -> Array:
    """Return the value of the k-th of m visits; a value without the visits' dimension belongs to all."""
    own = {**DIMENSIONS, **QUERY_DIMENSIONS}[key]
    if value.ndim == own + 1 and len(value) == m and (key != "f" or m != 2):
        return np.asarray(value[k])
    if value.ndim == own or (key in ("f", "mm_per_px") and value.size in (1, 2)):
        return value
    raise TabletDataError(f"'{path.name}': {key} has the shape {value.shape}, which does not fit the {m} visits of uv.")


def _visit(name: str, d: dict[str, Array], path: Path) -> PlanarVisit:
    where = f"'{path.name}'" + (f", visit {name}" if name else "")
    n = len(d["uv"])
    for key in (*ROWS, "depth"):
        shape = (n,) if DIMENSIONS[key] == 1 else (n, 2)
        if d[key].shape != shape:
            raise TabletDataError(f"{where}: {key} must have the shape {shape}, and it has {d[key].shape}.")
    if d["mm_per_px"].size != 1 or d["f"].size not in (1, 2):
        raise TabletDataError(f"{where} must hold one mm_per_px and one or two f.")
    good = np.array([all(np.isfinite(d[key][i]).all() for key in ROWS) for i in range(n)], dtype=bool)
    if good.sum() < MIN_LANDMARKS:
        raise TooFewLandmarks(
            f"{where} has {int(good.sum())} landmarks with finite numbers; at least {MIN_LANDMARKS} are needed, "
            "better all nine."
        )
    theta = d["theta_deg"][good]
    if np.abs(theta).max() <= 2.0 * np.pi and np.ptp(theta) > 0.5:
        raise EqualRotations(
            f"{where}: theta_deg runs over {np.ptp(theta):.2f} only, as radians would; it must be in degrees."
        )
    focal = np.broadcast_to(d["f"].ravel(), 2).copy()
    if not (np.isfinite(focal).all() and (focal > 0.0).all()):
        raise TabletDataError(f"{where}: f must be a positive number of pixels.")
    if d["c"].shape != (2,) or d["hand_capture"].shape != (3,):
        raise TabletDataError(f"{where}: c must hold 2 numbers and hand_capture 3.")
    pitch_m = 1e-3 * float(d["mm_per_px"].reshape(()))
    rows = tuple(int(i) for i in np.nonzero(good)[0])
    landmark, delta = d["tablet_px"][good], d["delta_px"][good]
    check_page_match(
        landmark - delta, landmark, tuple(map(str, rows)), 1e3 * pitch_m, f"{path.name}{name and f' visit {name}'}"
    )
    depth_m, seen = 1e-3 * d["depth"][good], d["depth"][good] > 0.0
    if not seen.all():
        rays = (d["uv"][good] - d["c"]) / focal
        landmark_m = pitch_m * d["tablet_px"][good]
        X_CT = tablet_pose(rays, landmark_m)
        depth_m = np.where(seen, depth_m, X_CT.multiply(np.c_[landmark_m, np.zeros(len(rays))].T)[2])
    touches = TabletTouches(
        uv_px=d["uv"][good],
        depth_m=depth_m,
        hand_m=1e-3 * d["hand"][good],
        theta_rad=np.radians(theta),
        delta_px=d["delta_px"][good],
        landmark_px=d["tablet_px"][good],
        pitch_m=pitch_m,
        focal_px=focal,
        centre_px=d["c"],
        hand_capture_m=1e-3 * d["hand_capture"],
    )
    return PlanarVisit(name, touches, _queries(d, where), rows, tuple(int(i) for i in np.nonzero(~good)[0]))


def _queries(d: dict[str, Array], where: str) -> Queries | None:
    if "uv_q" not in d:
        return None
    uv, theta, hand = d["uv_q"], d["theta_q"], d["hand_q"]
    if uv.ndim != 2 or uv.shape[1] != 2 or theta.shape != (len(uv),) or hand.shape != uv.shape or len(uv) == 0:
        raise TabletDataError(f"{where}: uv_q (q, 2), theta_q (q) and hand_q (q, 2) must be as many.")
    if not (np.isfinite(uv).all() and np.isfinite(theta).all() and np.isfinite(hand).all()):
        raise TabletDataError(f"{where}: uv_q, theta_q or hand_q holds a value that is not finite.")
    if np.abs(theta).max() > 2.5 * np.pi:
        raise TabletDataError(f"{where}: theta_q must be in radians, and it goes to {np.abs(theta).max():.0f}.")
    return Queries(uv, theta, 1e-3 * hand)
