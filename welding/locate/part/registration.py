"""Registers any part to scans: rough poses, fine fits, comparison by the scanner's rays, and the decision."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.mesh import TriMesh
from weldcal.welding.locate.part.agreement import Agreement, agreement, compared, rays_near, views_off
from weldcal.welding.locate.part.fit import PartFit, coarse_fit, fine_fit
from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.part.result import AmbiguousPart, PartConfig, PartNotFound, PartRegistration
from weldcal.welding.locate.part.rivals import (
    describe_turn,
    free_directions,
    harmless,
    own_axes,
    same_pose,
    same_set,
    turned_poses,
)
from weldcal.welding.locate.part.scan import PreparedScan, prepare
from weldcal.welding.locate.part.search import LARGE_GATES, LARGE_M, rough_places, sinks
from weldcal.welding.locate.planes import Floats, finite_points

COARSE_GATES = (0.020, 0.016, 0.012, 0.009, 0.007, 0.005)
COARSE_TOLERANCE_M, TOLERANCE_M = 0.004, 0.0010
SHEET = 0.5  # the same of a sheet, in its thickness: nearer to the sheet than to its table
SHEET_TOLERANCE_M = 0.0004  # at least: four times a scan's noise of 0.1 mm
FINE_PLACES, FINE_RIVALS, MIRRORED = 10, 5, 2
LARGE_PLACES = 40  # of a large part: the true place of the tests' beam 7009 is the 32nd
CLEAN = 0.98  # least share of the rays that meets a pose that ends the search; a beam turned by 180 deg has 0.97
PASSED = 0.005  # largest share that passes through it; of the true pose flying points are 0.002, of a wrong one 0.012
NEAR_HINT_DEG = 40.0  # under half of the least turn in TURNS_DEG: at most one of equal poses is so near
# The coarse score of the second of two equal parts is 0.92 to 1.00 of the best one: "two equal parts" of
# tests/welding/locate/lying.py, seeds 7000 to 7004. Where one part lies there the best start at another place has 0 and
# 0.46 ("thin sheet", "clamps", seed 7000).
EQUAL_PART = 0.75  # of the best coarse score: a start at another place that may be an equal part
# Right poses: the same module, --seed 1700. Wrong ones, two of each, seeds from 7000: another part, none, one of the
# other hand, one that is 8 % smaller than drawn.
# Clamps hide at most 7 % of the rays of a right pose, a fixture 18 %, a cover 41 to 54 %; of wrong ones 0 to 9 % are
# hidden. A cover is named.
MUCH_HIDDEN = 0.4  # share of the rays that end before the part, which a refusal names as its cause
# Where nothing stands before the part, 97 % of a right pose's rays meet and at most 1 % pass through. Of wrong ones 54
# to 99 % meet and 1 to 46 % pass through. Of the other hand 96 and 99 % meet, 4 and 1 % pass through: these limits
# keep no wrong part out. They choose a refusal's sentence.
POOR_MET, POOR_PASSED = 0.9, 0.04  # a pose that agrees less, and is as good as another, is refused as another part
HIDDEN = 0.15  # share of the rays that end before the part, above which something hides it
PLAIN_PLACES, COVERED_PLACES = 7, 6  # fitted finely before others: by all rays, and by those that nothing keeps from it
LARGEST, SMALLEST = 2.5, 8.0  # size of a part: of what the scan shows, and in point distances
COMPARABLE = 0.5  # of the best score: a rival with less meets the table only
CLEAR = 0.25  # of the best pose's rays: a rival with less has one ray in five where the two differ
LARGER = 0.9  # size of a part that one scan does not show, in the scan's extent: its margin is a tenth
ELSEWHERE = 0.85  # of the best score: a rival at another place with less is worse


@dataclass(frozen=True, eq=False)
class _Judged:
    fit: PartFit
    agreement: Agreement

    @property
    def X_BP(self) -> RigidTransform:
        return self.fit.X_BP


def register_part(
    points_B: npt.NDArray[np.floating] | Sequence[npt.NDArray[np.floating]],
    mesh: TriMesh,
    X_BP_guess: RigidTransform | None = None,
    eye_B: npt.ArrayLike | None = None,
    *,
    X_BP_hint: RigidTransform | None = None,
    matters_P: Floats | None = None,
    config: PartConfig | None = None,
) -> PartRegistration:
    """Register a part to a scan (N,3) or (H,W,3), or to a list of scans of one scene, m in base, NaN where unmeasured.

    Args:
        points_B: the scan or the scans.
        mesh: the part in its frame P, m.
        X_BP_guess: search only near it (config.reach_m, reach_rad).
        eye_B: the scanner's position (3,), or (V,3) for a list of V scans, m in base.
        X_BP_hint: decides between poses that look the same; has no other use.
        matters_P: points (N,3) of the seam. A free direction that leaves them, as a set, where they are is not refused.
        config: limits of the search and of the decision.

    Returns:
        The pose with its covariance and the scan's agreement.

    Raises:
        PartNotFound: too few points of the part are seen, or it does not fit.
        AmbiguousPart: the part has free directions, which the text names, or looks the same elsewhere.
        InputError: a scan has another shape, or several scans have no position for each.
    """
    config = config or PartConfig()
    scan = prepare(finite_points(points_B), eye_B, config.min_points, config.seed)
    model = PartModel(mesh, config.seed)
    return decided(candidates(scan, model, X_BP_guess, X_BP_hint, config), scan, model, matters_P)


@dataclass(frozen=True, eq=False)
class Candidates:
    """The best pose of a part in a scan and its rivals, whichever of its seams matters."""

    best: _Judged
    rivals: list[_Judged]
    hint: RigidTransform | None
    config: PartConfig


def decided(found: Candidates, scan: PreparedScan, model: PartModel, matters_P: Floats | None) -> PartRegistration:
    """Decide among the poses of a part for the points of one seam; see register_part."""
    _check_known(found.best, model, matters_P, found.config)
    best, runner_up, note = _decided(found.best, found.rivals, scan, model, found.hint, matters_P, found.config)
    return _result(best, runner_up, note, model, matters_P)


def candidates(
    scan: PreparedScan,
    model: PartModel,
    X_BP_guess: RigidTransform | None,
    X_BP_hint: RigidTransform | None,
    config: PartConfig,
) -> Candidates:
    """Find the best pose of a part in a scan, and its rivals; see register_part."""
    hint = X_BP_guess if X_BP_hint is None else X_BP_hint
    _check_size(scan, model)
    starts = _near_starts(scan, model, X_BP_guess) if X_BP_guess is not None else _starts(scan, model, config)
    fits = _fine(scan, model, starts, LARGE_PLACES if model.radius > LARGE_M else FINE_PLACES)
    if not fits:
        raise PartNotFound(
            "The scan shows nothing that fits the part: move it into view, or check the file and its unit."
        )
    _check_fused(fits[0], scan, model)
    # Of a part that is half hidden few rays speak: those that nothing keeps from it decide among poses that agree.
    fits.sort(key=lambda f: (not _agrees(f.agreement, config), -f.agreement.score_of_rest))
    standing = [f for f in fits if not sinks(scan, model, f.X_BP)]
    fits = standing if standing and _agrees(standing[0].agreement, config) else fits
    best = fits[0]
    if X_BP_guess is not None:
        _check_near(best.X_BP, X_BP_guess, model, config)
    rivals, best_sinks = fits[1:], sinks(scan, model, best.X_BP)
    if X_BP_guess is None:
        others = turned_poses(model, best.X_BP)
        found = _fine(scan, model, _screened(scan, model, others, best, hint), FINE_RIVALS, None)
        known = [f.X_BP for f in fits]
        rivals += [
            f
            for f in found
            if not any(same_pose(f.X_BP, X, model) for X in known) and (sinks(scan, model, f.X_BP) <= best_sinks)
        ]
        better = [r for r in rivals if _better(r, best, scan, model)]
        if better:
            rivals = [f for f in (best, *rivals) if f is not better[0]]
            best = better[0]
    _check_fused(best, scan, model)
    _check_fit(best, scan, model, config)
    _check_hand(best, scan, model)
    return Candidates(best, rivals, hint, config)


def _check_size(scan: PreparedScan, model: PartModel) -> None:
    """Raise PartNotFound where the part is far too large or too small to be seen in the scan."""
    seen, size = scan.extent_m, 2.0 * model.radius
    if size > LARGEST * seen or size < SMALLEST * scan.pitch_m:
        raise PartNotFound(
            f"The part is {size:.3g} m across, and the scan shows {seen:.3g} m with {1e3 * scan.pitch_m:.2g} mm between"
            " its points: check the unit of the part's file."
        )


def _starts(scan: PreparedScan, model: PartModel, config: PartConfig) -> list[RigidTransform]:
    """Poses from the search, fitted to the coarse points, best first."""
    scored: list[tuple[float, float, RigidTransform]] = []
    sunk: list[RigidTransform] = []
    for place in rough_places(scan, model, config):
        # A flat part may slide along itself in the coarse fit, or a fixture may pull it: the pose before is a start.
        wide = tuple(g * model.radius for g in LARGE_GATES) if model.radius > LARGE_M else ()
        gates = (*wide, *COARSE_GATES)
        for X in (place.X_BP, coarse_fit(scan, model, place.X_BP, gates)):
            if X is None or any(same_pose(X, Y, model) for _, _, Y in scored):
                continue
            if sinks(scan, model, X):
                sunk.append(X)
                continue
            a = agreement(rays_near(scan, model, X)[::5], scan, model, X, COARSE_TOLERANCE_M)
            scored.append((a.score, a.score_of_rest if a.hidden > HIDDEN else 0.0, X))
    # Of a part that something hides, the rays that nothing keeps from it decide.
    behind = sorted((s for s in scored if s[1] > 0.0), key=lambda s: -s[1])[:COVERED_PLACES]
    scored.sort(key=lambda s: -s[0])
    first = [s for s in scored[:PLAIN_PLACES] if s not in behind]
    # An equal part at another place is a rival that must not be missed.
    second = [
        s for s in scored if s[0] > EQUAL_PART * scored[0][0] and _apart(s[2], scored[0][2], model) and s not in behind
    ]
    first = [*first[:2], *second[:1], *(s for s in first[2:] if s not in second[:1])]
    return [X for _, _, X in [*first, *behind, *(s for s in scored if s not in first and s not in behind)]] + sunk


def _near_starts(scan: PreparedScan, model: PartModel, guess: RigidTransform) -> list[RigidTransform]:
    """The guess, fitted to the coarse points from a wide and from a narrow gate."""
    fits = [coarse_fit(scan, model, guess, gates) for gates in ((0.025, 0.022, *COARSE_GATES), COARSE_GATES[2:])]
    return [X for X in fits if X is not None]


def _screened(
    scan: PreparedScan, model: PartModel, poses: list[RigidTransform], best: _Judged, hint: RigidTransform | None
) -> list[RigidTransform]:
    """The poses that agree roughly with the scan: first the one nearest to the hint, then best first."""
    scored: list[tuple[float, RigidTransform]] = []
    for X in poses:
        fitted = coarse_fit(scan, model, X, COARSE_GATES[2:])
        if fitted is None or any(same_pose(fitted, X, model) for X in (best.X_BP, *(Y for _, Y in scored))):
            continue
        score = agreement(rays_near(scan, model, fitted)[::3], scan, model, fitted, COARSE_TOLERANCE_M).score
        if score > 0.5 * best.agreement.score:
            scored.append((score, fitted))
    scored.sort(key=lambda s: -s[0])
    ranked = [X for _, X in scored]
    if hint is not None:
        ranked.sort(key=lambda X: _away(X, hint, model) > math.radians(NEAR_HINT_DEG))
    return ranked


def _fine(
    scan: PreparedScan, model: PartModel, starts: list[RigidTransform], most: int, enough: int | None = 5
) -> list[_Judged]:
    """Fit the best starts finely, different ones only, best first.

    After `enough` a good and clean one ends the search.
    """
    judged: list[_Judged] = []
    for X in starts[:most]:
        known = [j.agreement for j in judged]
        clean = any(a.score > 0.8 and a.met > CLEAN and a.passed < PASSED for a in known)
        if enough is not None and len(judged) > enough and clean:
            break
        fit = fine_fit(scan, model, X)
        if fit is None or any(same_pose(fit.X_BP, j.X_BP, model) for j in judged):
            continue
        rays = rays_near(scan, model, fit.X_BP)
        judged.append(_Judged(fit, agreement(rays, scan, model, fit.X_BP, _tolerance(model))))
    judged.sort(key=lambda j: -j.agreement.score)
    return judged


def _tolerance(model: PartModel) -> float:
    """Compute how far a ray that meets the part may end from it, m; less than a sheet's thickness."""
    return min(TOLERANCE_M, max(SHEET_TOLERANCE_M, SHEET * model.thickness_m))


def _evidence(
    a: _Judged, b: _Judged, scan: PreparedScan, model: PartModel, model_b: PartModel | None = None
) -> tuple[int, int, int]:
    """Numbers of rays that speak for a and for b where the two differ, and of those that meet a."""
    both = [(a.X_BP, model), (b.X_BP, model_b or model)]
    rays = np.unique(np.concatenate([rays_near(scan, m, X) for X, m in both]))
    met, passed, _ = zip(*(compared(rays, scan, m, X, _tolerance(m)) for X, m in both), strict=True)
    va, vb = (one.astype(int) - other for one, other in zip(met, passed, strict=True))
    return int(np.sum(va > vb)), int(np.sum(vb > va)), int(np.sum(met[0]))


def _better(rival: _Judged, best: _Judged, scan: PreparedScan, model: PartModel) -> bool:
    # Rays that meet a table speak for any pose on it: its score must be comparable too.
    if rival.agreement.score < COMPARABLE * best.agreement.score:
        return False
    # Elsewhere other rays speak: what stands before one of the two must not speak for the other.
    if _apart(best.X_BP, rival.X_BP, model) and rival.agreement.score_of_rest < best.agreement.score_of_rest:
        return False
    more, less, met = _evidence(rival, best, scan, model)
    return more > less + max(30, 0.01 * met)


def _apart(A: RigidTransform, B: RigidTransform, model: PartModel) -> bool:
    """Whether two poses are at different places: their middles are more than half the part's radius apart."""
    return bool(np.linalg.norm(A.multiply(model.center) - B.multiply(model.center)) > 0.5 * model.radius)


def _check_near(X: RigidTransform, guess: RigidTransform, model: PartModel, config: PartConfig) -> None:
    E = guess.InvertAndCompose(X)
    turn = float(np.linalg.norm(_rotvec(E)))
    shift = float(np.linalg.norm(E.multiply(model.center) - model.center))
    if turn > config.reach_rad or shift > config.reach_m:
        raise PartNotFound(
            f"The part fits the scan only {1e3 * shift:.0f} mm and {math.degrees(turn):.0f} deg from the guess: correct"
            " the guess, or search without one."
        )


def _away(X: RigidTransform, hint: RigidTransform, model: PartModel) -> float:
    """How far a pose is from the hint: its turn, rad, and its shift, in 0.3 m."""
    shift = float(np.linalg.norm(hint.multiply(model.center) - X.multiply(model.center)))
    return float(np.linalg.norm(_rotvec(hint.InvertAndCompose(X)))) + shift / 0.3


def _rotvec(X: RigidTransform) -> Floats:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(X.rotation().matrix()).as_rotvec())


def _check_fused(best: _Judged, scan: PreparedScan, model: PartModel) -> None:
    """Raise PartNotFound where one of several scans shows the part elsewhere than the others."""
    off = views_off(scan, model, best.X_BP, _tolerance(model)) if len(scan.views) > 1 else []
    if off and len(off) < len(scan.views):
        numbers = ", ".join(str(k + 1) for k in off)
        raise PartNotFound(
            f"Of {len(scan.views)} scans, number {numbers} shows the part elsewhere than the others. The arm, the "
            "scanner or the part moved, or X_BC is wrong: scan again, or correct the calibration."
        )


def _check_hand(best: _Judged, scan: PreparedScan, model: PartModel) -> None:
    """Raise PartNotFound where the part's mirror image agrees better with the scan than the part."""
    flip = np.diag([-1.0, 1.0, 1.0])
    mirror = PartModel(TriMesh(model.mesh.vertices @ flip, model.mesh.triangles[:, ::-1]))
    starts: list[tuple[float, RigidTransform]] = []
    for a in own_axes(model):
        R = (np.eye(3) - 2.0 * np.outer(a, a)) @ flip  # turns the mirror image in x to that in the plane across a
        at = best.X_BP @ RigidTransform(RotationMatrix(R), model.center - R @ flip @ model.center)
        X = coarse_fit(scan, mirror, at, COARSE_GATES[2:])
        if X is not None:
            rays = rays_near(scan, mirror, X)[::3]
            starts.append((agreement(rays, scan, mirror, X, COARSE_TOLERANCE_M).score, X))
    starts.sort(key=lambda s: -s[0])
    for other in _fine(scan, mirror, [X for _, X in starts], MIRRORED, None):
        more, less, met = _evidence(other, best, scan, mirror, model)
        if more > less + max(30, 0.004 * met):
            raise PartNotFound(
                f"The part does not fit the scan: its mirror image fits better ({more} rays for it, {less} against). "
                "The part of the other hand lies there, or the file is mirrored."
            )


def _agrees(a: Agreement, config: PartConfig) -> bool:
    """Whether nothing in the scan refuses a pose."""
    return (
        a.n_met >= config.min_points
        and a.seen >= config.min_seen
        and a.goes_on <= config.max_goes_on
        and a.met >= max(config.min_met, config.min_agreement * (1.0 - a.hidden))
        and a.passed <= config.max_violation
    )


def _check_fit(best: _Judged, scan: PreparedScan, model: PartModel, config: PartConfig) -> None:
    """Raise PartNotFound where the best pose does not agree with the scan."""
    a, shown, size = best.agreement, scan.extent_m, 2.0 * model.radius
    advice, check = "clear the view, or scan it from elsewhere", "check which part this is and the file's unit"
    if a.hidden > MUCH_HIDDEN:
        advice = check = f"something hides {100 * a.hidden:.0f} % of it: clear the view, or scan it from elsewhere"
    if len(scan.views) > 1:
        advice = (
            "correct X_BC of the scans (X_FC of a scanner on the flange), clear the view, or scan it from elsewhere"
        )
    elif size > LARGER * shown:
        advice = (
            f"the part is {size:.2g} m across, larger than the {shown:.2g} m of the scan: scan it from several poses"
            " with a scanner on the flange (weldcal new FOLDER --part FILE --from carried_scanner writes them to"
            " planning.scan_poses_deg)"
        )
        check = advice
    if a.n_met < config.min_points:
        raise PartNotFound(
            f"The scan shows only {a.n_met} points of the part, and {config.min_points} are needed: {advice}."
        )
    if a.seen < config.min_seen:
        raise PartNotFound(
            f"The scan shows only {100 * a.seen:.0f} % of the part's visible surface ({a.n_met} points): {advice}."
        )
    if a.goes_on > config.max_goes_on:
        raise PartNotFound(
            f"The part does not fit the scan: at {100 * a.goes_on:.0f} % of its edges the face does not end; {check}."
        )
    if a.met < config.min_met:
        raise PartNotFound(
            f"The part does not fit the scan: only {100 * a.met:.0f} % of the rays that should meet it do. Something"
            " hides it: clear the view, or check which part this is."
        )
    if a.met < config.min_agreement * (1.0 - a.hidden) or a.passed > config.max_violation:
        raise PartNotFound(
            f"The part does not fit the scan: of the rays that should meet it {100 * a.met:.0f} % do and"
            f" {100 * a.passed:.0f} % pass through it. Check which part this is, the file's unit and the calibration."
        )


def _decided(
    best: _Judged,
    rivals: list[_Judged],
    scan: PreparedScan,
    model: PartModel,
    hint: RigidTransform | None,
    matters_P: Floats | None,
    config: PartConfig,
) -> tuple[_Judged, float, str]:
    """The pose among those that look the same, how good the best other one is, and where an equal part lies.

    Raises:
        AmbiguousPart: nothing decides.
    """
    alike: list[_Judged] = []
    runner_up = 0.0
    for rival in rivals:
        if rival.agreement.passed > 2.0 * config.max_violation:
            continue
        for_best, for_rival, met = _evidence(best, rival, scan, model)
        share = for_rival / max(1, for_best)
        runner_up = max(runner_up, min(1.0, rival.agreement.score / max(best.agreement.score, 1e-9)))
        # Another part of the kind is as good where something hides a share of it.
        if _apart(best.X_BP, rival.X_BP, model) and (
            rival.agreement.met < config.min_met
            or rival.agreement.score_of_rest < ELSEWHERE * best.agreement.score_of_rest
        ):
            continue
        # A small lug is a small difference: it decides where hardly a ray speaks against it.
        least = max(30, (0.004 if share < CLEAR else 0.008) * met)
        if for_best - for_rival < least or share > config.rival:
            alike.append(rival)
    harmful = [r for r in alike if not same_set(matters_P, best.X_BP.InvertAndCompose(r.X_BP))]
    harmful.sort(key=lambda r: -r.agreement.score)  # the first is named
    if hint is not None and alike:
        family = [best, *alike]
        cost = np.array([_away(f.X_BP, hint, model) for f in family])
        order = np.argsort(cost)
        if cost[order[1]] - cost[order[0]] > math.radians(20.0):
            best = family[int(order[0])]
            places = [f.X_BP.multiply(model.center) for f in family]
            far = [p for p in places if np.linalg.norm(p - best.X_BP.multiply(model.center)) > model.radius]
            return best, runner_up, f"; an equal part lies near {_in_mm(far[0])}" if far else ""
    shown = best.agreement
    if harmful and (shown.met < POOR_MET * (1.0 - shown.hidden) or shown.passed > POOR_PASSED):
        raise PartNotFound(
            f"The part does not fit the scan: in its best pose {100 * shown.passed:.0f} % of the rays pass through it,"
            " and other poses fit as badly. Check which part this is and the file's unit."
        )
    if harmful:
        motion = best.X_BP.InvertAndCompose(harmful[0].X_BP)
        near = float(np.linalg.norm(motion.multiply(model.center) - model.center)) < 0.5 * model.radius
        if near:
            raise AmbiguousPart(
                f"The part's pose is ambiguous: {describe_turn(motion)}; give a guess of its pose, or scan it from"
                " where its sides differ."
            )
        a, b = (_in_mm(x.X_BP.multiply(model.center)) for x in (best, harmful[0]))
        raise AmbiguousPart(
            f"Two places in the scan look equally like the part: near {a} and {b}; "
            "cover or remove one, or give a guess of where the part is."
        )
    return best, runner_up, ""


def _in_mm(p: Floats) -> str:
    """A place (3,) m, in words."""
    return "({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * p))


def _check_known(best: _Judged, model: PartModel, matters_P: Floats | None, config: PartConfig) -> None:
    """Raise AmbiguousPart where the scan leaves a direction free that matters."""
    free = free_directions(model, best.X_BP, best.fit.covariance, config.max_sigma_m)
    harmful = [f.name for f in free if not harmless(f, matters_P)]
    if harmful:
        raise AmbiguousPart(
            f"The part was found, but the scan does not fix its pose: it is {' and '.join(harmful)}. Scan it so that"
            " more of its sides or ends are in view, or give its pose."
        )


def _result(best: _Judged, runner_up: float, note: str, model: PartModel, matters_P: Floats | None) -> PartRegistration:
    a = best.agreement
    confidence = float(
        np.clip((a.met / max(1e-9, 1.0 - a.hidden) - a.passed) * (1.0 - max(0.0, runner_up - 0.7)), 0.0, 1.0)
    )
    found = PartRegistration(
        X_BP=best.X_BP,
        covariance=best.fit.covariance,
        rms_m=best.fit.rms_m,
        agreement=a.met,
        seen=a.seen,
        confidence=confidence,
        summary="",
    )
    at = model.points[::300] if matters_P is None else np.asarray(matters_P)
    sigma = float(np.sqrt(np.mean(np.square(found.sigma_at(at)))))
    word = "high" if confidence > 0.85 else "fair" if confidence > 0.65 else "low"
    what = "the part" if matters_P is None else "the drawn seam"
    summary = (
        f"{word} confidence {confidence:.2f}: {100 * a.met:.0f} % of the rays that should meet the part do,"
        f" {100 * a.passed:.0f} % pass through it, {100 * a.seen:.0f} % of its visible surface is seen; {what} is known"
        f" to {1e3 * sigma:.2f} mm{note}"
    )
    return replace(found, summary=summary)
