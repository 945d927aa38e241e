"""Finds a plate in a scan without an initial guess: template search over all faces and turns, then fine registration.

Coarse: the planes that face up; on each, the outline as a template (face inside, none just outside) correlated with
what was seen, over all turns. Fine: register_workpiece from the best of these places. The answer is compared with its
runners-up: a second place that fits as well, or a half turn that looks the same, is refused as ambiguous. Where the
outline is symmetric the groove decides, if it is drawn asymmetrically and can be seen.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform
from scipy.spatial import cKDTree

from weldcal.models.workpieces.plate import Workpiece
from weldcal.welding.locate.bent_face import BentFace, find_bent_faces
from weldcal.welding.locate.bent_registration import RADIUS_SHARE, flattened, into_plate
from weldcal.welding.locate.planes import (
    PLANE_BAND_M,
    Floats,
    finite_points,
    into,
    point_pitch,
    robust_plane,
    thinned,
    turned,
    upward_planes,
)
from weldcal.welding.locate.registration import (
    RegistrationConfig,
    WorkpieceNotFound,
    WorkpieceRegistration,
    register_workpiece,
)

COARSE_POINTS = 120_000
CLOSE_M, CLOSE_RAD = 0.004, math.radians(1.5)  # how far the coarse place may be off
STEEPEST_RAD = math.radians(20.0)  # largest tilt of the part's face from the up direction
CELL_M, TURN_STEP_RAD = 0.004, math.radians(4.0)  # of the coarse search
CANDIDATES = 6  # places that are registered finely
AMBIGUOUS = 0.9  # a runner-up whose score is above this share of the best one's is as good
GROOVE_REACH_M = 0.006  # how far the real groove may lie from the drawn one
LEAST_GROOVE = 0.2  # smallest agreement (-1 to 1) of the groove seen with the one drawn
FINE = RegistrationConfig(max_shift_m=0.010, max_turn_rad=math.radians(4.0))
SEED = 0


class AmbiguousWorkpiece(WorkpieceNotFound):
    """The scan agrees with two positions or two orientations of the part, and nothing distinguishes them."""


@dataclass(frozen=True, eq=False)
class FoundWorkpiece:
    """The pose of the part found, and its confidence.

    Attributes:
        registration: the fine registration at the place found.
        groove: agreement of the groove seen with the one drawn here, -1 to 1; None where it could not be seen.
        confidence: 0 to 1: supported less contradicted share of the outline, reduced by the runner-up.
        summary: the result in one sentence.
    """

    registration: WorkpieceRegistration
    groove: float | None
    confidence: float
    summary: str

    @property
    def X_BP(self) -> RigidTransform:
        """Pose of the plate in the base."""
        return self.registration.X_BP


def find_workpiece(
    points_B: npt.NDArray[np.floating],
    workpiece: Workpiece,
    *,
    turn_hint_rad: float | None = None,
    eye_B: npt.ArrayLike | None = None,
) -> FoundWorkpiece:
    """Find the plate in a scan (N,3) or (H,W,3), metres in base with z up, at any position and turn about z.

    ``turn_hint_rad``: the part's turn about z to within 90 deg, for parts that look the same after half a turn.
    eye_B (3,): the scanner's position, for the covariance.

    Raises:
        WorkpieceNotFound, AmbiguousWorkpiece: in a sentence; InputError for a scan of the wrong shape.
    """
    (points,) = finite_points([points_B])
    if len(points) < FINE.min_points:
        raise WorkpieceNotFound(f"The scan has only {len(points)} points: move the workpiece into view.")
    # A thinned scan is enough to find the place; the final registration uses all points.
    few = thinned(points, COARSE_POINTS)
    coarse = FINE if few is points else replace(FINE, max_sigma_m=math.inf)
    places = _places(few, workpiece)
    bent = math.isfinite(workpiece.bend_radius_m)
    if not places:
        what = f"face bent over {1e3 * workpiece.bend_radius_m:.0f} mm" if bent else "flat face"
        raise WorkpieceNotFound(f"The scan shows no {what} that could be the workpiece: move it into view.")
    fits: list[tuple[float, WorkpieceRegistration]] = []
    refusal: WorkpieceNotFound | None = None
    for _, X_BP in places:
        if any(_same_place(X_BP, f.X_BP, workpiece) for _, f in fits):
            continue
        try:
            found = register_workpiece(few, workpiece, X_BP, coarse, eye_B)
        except WorkpieceNotFound as error:
            refusal = refusal or error
            continue
        if not any(_same_place(found.X_BP, f.X_BP, workpiece) for _, f in fits):
            fits.append((found.confidence, found))
    if not fits:
        raise refusal or WorkpieceNotFound("The scan shows no such workpiece: check which one this is.")
    # Each place in both turns, scored by outline and groove.
    judged = []
    for score, found in fits:
        turns = [found] if not _half_turn_fits(workpiece) else [found, found.turned_round(workpiece)]
        grooves = _groove_agreement(few, workpiece, [t.X_BP for t in turns])
        judged.append((score, turns, grooves))
    judged.sort(key=lambda j: -(j[0] + max((g for g in j[2] if g is not None), default=0.0)))
    _, turns, grooves = judged[0]
    other = 0.0
    if len(judged) > 1:
        mine, theirs = (s * (1.0 + max((g for g in gs if g is not None), default=0.0)) for s, _, gs in judged[:2])
        other = max(0.0, theirs) / max(mine, 1e-9)
    if other > AMBIGUOUS:
        a, b = (1e3 * j[1][0].X_BP.translation() for j in judged[:2])
        raise AmbiguousWorkpiece(
            f"Two places in the scan look equally like the {workpiece.name}: near ({a[0]:.0f}, {a[1]:.0f}) and "
            f"({b[0]:.0f}, {b[1]:.0f}) mm; cover or remove one, or give a guess of where the part is."
        )
    if few is not points:
        close = replace(FINE, max_shift_m=CLOSE_M, max_turn_rad=CLOSE_RAD)
        exact = register_workpiece(points, workpiece, turns[0].X_BP, close, eye_B)
        turns = [exact, exact.turned_round(workpiece)][: len(turns)]
    return _decided(workpiece, turns, grooves, other, turn_hint_rad)


def _decided(
    workpiece: Workpiece,
    turns: list[WorkpieceRegistration],
    grooves: list[float | None],
    other: float,
    turn_hint_rad: float | None,
) -> FoundWorkpiece:
    """Choose between the two turns and return the result with its confidence; raise where nothing decides."""
    seen = [g for g in grooves if g is not None]
    if seen and max(seen) < LEAST_GROOVE:
        raise WorkpieceNotFound(
            f"A plate of the size of the {workpiece.name} is there, but its groove is not where the drawing has one: "
            "check which workpiece this is."
        )
    chosen, why = 0, "its outline fits in one turn only"
    if len(turns) == 2:
        a, b = grooves
        if a is not None and b is not None and abs(a - b) > 0.25:
            chosen, why = (0, 1)[b > a], "the groove tells its two turns apart"
        elif turn_hint_rad is not None:
            headings = [_heading(t.X_BP) for t in turns]
            off = [abs(math.remainder(h - turn_hint_rad, 2.0 * math.pi)) for h in headings]
            chosen, why = int(np.argmin(off)), "the hint says which of its two turns it is"
            if abs(off[0] - off[1]) < math.radians(20.0):
                raise AmbiguousWorkpiece(
                    "The part looks the same turned by 180 deg and lies square to the guess of its turn: give a guess "
                    "within 80 deg of the truth."
                )
        else:
            what = "its groove cannot be seen" if a is None else "so does its groove"
            raise AmbiguousWorkpiece(
                f"The part looks the same turned by 180 deg: its outline is symmetric and {what}; give a guess of its "
                "turn to within 80 deg."
            )
    found = turns[chosen]
    confidence = float(np.clip(found.confidence * (1.0 - max(0.0, other - 0.5)), 0.0, 1.0))
    word = "high" if confidence > 0.85 else "fair" if confidence > 0.65 else "low"
    summary = (
        f"{word} confidence {confidence:.2f}: {found.summary}; the next best place is {100 * other:.0f} % as good, and"
        f" {why}"
    )
    return FoundWorkpiece(found, grooves[chosen], confidence, summary)


def _places(points: Floats, workpiece: Workpiece) -> list[tuple[float, RigidTransform]]:
    """Rough poses of the outline on the faces in view, best first."""
    rng = np.random.default_rng(SEED)
    if math.isfinite(workpiece.bend_radius_m):
        return _bent_places(points, workpiece, rng)
    sample = points[rng.choice(len(points), size=min(len(points), 12000), replace=False)]
    center = np.median(sample, axis=0)
    places: list[tuple[float, RigidTransform]] = []
    for X in upward_planes(sample - center, STEEPEST_RAD, 120, rng, most=6):
        X_BQ = RigidTransform(center) @ X
        q = into(X_BQ, points)
        places += [(score, X_BQ @ X_QP) for score, X_QP in _correlate(q, workpiece)]
    places.sort(key=lambda place: -place[0])
    return places[:CANDIDATES]


def _bent_places(points: Floats, workpiece: Workpiece, rng: np.random.Generator) -> list[tuple[float, RigidTransform]]:
    """Rough poses on the bent faces in view; only half turns about the cylinder's normal are possible there."""
    radius = workpiece.bend_radius_m
    places: list[tuple[float, RigidTransform]] = []
    for seen in find_bent_faces(points, ((1.0 - RADIUS_SHARE) * radius, (1.0 + RADIUS_SHARE) * radius), rng):
        face = BentFace(seen.X_AQ, radius)
        for score, X in _correlate(face.unrolled(points), workpiece, (0.0, math.pi)):
            x, y, _ = X.translation()
            places.append((score, face.at(float(x), float(y), _heading(X))))
    places.sort(key=lambda place: -place[0])
    return places[:CANDIDATES]


def _correlate(
    q: Floats, workpiece: Workpiece, only: tuple[float, ...] | None = None
) -> list[tuple[float, RigidTransform]]:
    """The few best poses of the outline in one plane.

    Turns by template (`only` these, where given), places by correlation.
    """
    cell = CELL_M
    reach = 0.5 * float(np.hypot(*workpiece.size_m[:2]))
    corner = q[:, :2].min(axis=0) - 0.3 * reach
    size = np.ceil((q[:, :2].max(axis=0) + 0.3 * reach - corner) / cell).astype(int)
    i = ((q[:, :2] - corner) / cell).astype(np.int64)
    seen = np.zeros((size[1], size[0]), dtype=np.float32)
    face = np.abs(q[:, 2]) < 2.0 * PLANE_BAND_M
    lower = q[:, 2] < -0.004
    seen[i[lower, 1], i[lower, 0]] = -1.0
    seen[i[face, 1], i[face, 0]] = 1.0
    pad = math.ceil(reach / cell) + 4
    seen = cv2.copyMakeBorder(seen, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=0.0)
    corner = corner - pad * cell
    if min(seen.shape) <= 2 * pad:
        return []
    best: list[tuple[float, RigidTransform]] = []
    turns = np.arange(0.0, math.pi if _half_turn_fits(workpiece) else 2.0 * math.pi, TURN_STEP_RAD)
    if only is not None:
        turns = np.array(only[:1] if _half_turn_fits(workpiece) else only)
    for turn in turns:
        template, share = _template(workpiece.outline_P, float(turn), pad, cell)
        score = cv2.matchTemplate(seen, template, cv2.TM_CCORR)
        for _ in range(2):
            k = int(np.argmax(score))
            row, column = divmod(k, score.shape[1])
            value = float(score[row, column]) / share
            if value < 0.3:
                break
            place = corner + (np.array([column, row]) + pad + 0.5) * cell
            best.append((value, turned(float(place[0]), float(place[1]), float(turn))))
            cv2.circle(score, (column, row), round(0.5 * reach / cell), -1e9, -1)
    best.sort(key=lambda place: -place[0])
    kept: list[tuple[float, RigidTransform]] = []
    for value, X in best:
        if len(kept) < 4 and not any(_same_place(X, other, workpiece) for _, other in kept):
            kept.append((value, X))
    return kept


def _template(outline: Floats, turn: float, pad: int, cell: float) -> tuple[npt.NDArray[np.float32], float]:
    """+1 inside the outline, minus as much in all in a ring just outside, and the score of a perfect match."""
    c, s = math.cos(turn), math.sin(turn)
    corners = outline @ np.array([[c, s], [-s, c]]) / cell + pad + 0.5
    inside = np.zeros((2 * pad + 1, 2 * pad + 1), dtype=np.uint8)
    cv2.fillPoly(inside, [np.round(corners * 16).astype(np.int32)], 1, shift=4)
    width = 2 * round(0.014 / cell) + 1
    ring = cv2.dilate(inside, np.ones((width, width), dtype=np.uint8)) - inside
    template = inside.astype(np.float32) - ring.astype(np.float32) * (inside.sum() / max(int(ring.sum()), 1))
    return template.astype(np.float32), 2.0 * float(inside.sum())


def _half_turn_fits(workpiece: Workpiece) -> bool:
    """Whether the outline looks the same after half a turn about its middle, to 2 mm."""
    outline = workpiece.outline_P
    middle = outline.mean(axis=0)
    distance, _ = cKDTree(outline).query(2.0 * middle - outline)
    return bool(np.max(distance) < 0.002)


def _heading(X: RigidTransform) -> float:
    x = X.rotation().matrix()[:, 0]
    return math.atan2(x[1], x[0])


def _same_place(A: RigidTransform, B: RigidTransform, workpiece: Workpiece) -> bool:
    """Whether two poses put the part into the same place, regardless of half turns of a symmetric part."""
    E = A.InvertAndCompose(B)
    turn = abs(math.remainder(_heading(E), math.pi if _half_turn_fits(workpiece) else 2.0 * math.pi))
    return float(np.linalg.norm(E.translation())) < 0.012 and turn < math.radians(8.0)


def _groove_agreement(points: Floats, workpiece: Workpiece, poses: list[RigidTransform]) -> list[float | None]:
    """For each pose: the drawn seam's share with a groove below it, less the share of what is below it elsewhere."""
    half_width = workpiece.half_width_m
    drawn_flat = flattened(workpiece)
    inner = 0.5 * np.array(workpiece.size_m[:2]) - 0.008
    out: list[float | None] = []
    for X_BP in poses:
        p = into_plate(X_BP, points, workpiece)
        inside = (np.abs(p[:, :2]) < inner).all(axis=1)
        plane = p[inside & (np.abs(p[:, 2]) < 0.004)]
        if len(plane) < 300:
            out.append(None)
            continue
        _, sigma = robust_plane(plane)
        pitch = point_pitch(plane[:, :2])
        low = p[inside & (p[:, 2] < -max(5.0 * sigma, 0.001)) & (p[:, 2] > -workpiece.size_m[2] + 0.004)][:, :2]
        line = drawn_flat.seam_P
        drawn = line[(np.abs(line[:, :2]) < inner).all(axis=1)][::4, :2]
        if len(low) < 40 or len(drawn) < 20:
            out.append(None)
            continue
        reach = GROOVE_REACH_M
        seen = np.asarray(cKDTree(plane[:, :2]).query(drawn)[0]) < 3.0 * half_width
        hit = np.asarray(cKDTree(low).query(drawn)[0]) < max(reach, pitch)
        miss = np.asarray(cKDTree(line[::4, :2]).query(low)[0]) > half_width + reach
        if np.count_nonzero(seen) < 0.3 * len(drawn):
            out.append(None)
            continue
        out.append(float(np.mean(hit[seen]) - np.mean(miss)))
    return out
