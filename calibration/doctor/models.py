"""Models of what disturbs a set of scans: a moved scanner, a TCP, a drift, a loose mount, wrong kinematics."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from weldcal.calibration.doctor.case import ArmDerivatives, DoctorCase
from weldcal.calibration.doctor.fit import CauseFit, fit
from weldcal.calibration.geometry.se3 import as_transform, exp_rotation, fit_with_offset, log_rotation, skew
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution
from weldcal.models.arms.kinematics import LINKS, Chain, chain_poses, known_arms
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

LEAST_PART = 3  # scans before and after a move
_LEAST_SHARE = 0.2  # of the scans in the smaller of two states
_STATES = 12  # reassignments of the scans to two states
_TURNED = 0.03  # rad from which on a face is turned by the TCP and not by noise
FEWEST_FOR_ARM = 9  # scans
FACTORY_RAD, FACTORY_M = 8e-4, 5e-4  # joint zeros and link lengths of a new arm, one sigma
_STEP_RAD, _STEP_M = 1e-4, 1e-3  # of numerical derivatives
_ANOTHER_ARM_M = 1e-3  # residuals below which the arm is the right one
_SIBLING_M = 0.1  # that arms may differ by in the same joints
_ZERO_RAD, _LENGTH_M = 5e-3, 4e-3  # what joint zeros and link lengths of two arms' files differ by, one sigma


@dataclass(frozen=True, eq=False)
class Explained:
    """A cause's model fitted.

    Its criterion (less is better), the fit, how far it moves the centres (rms, m) and its numbers.
    """

    cause: str
    bic: float
    fit: CauseFit
    effect_m: float
    numbers: dict[str, float]
    where: tuple[str, ...] = ()


def explanations(case: DoctorCase, null: CauseFit) -> Iterator[Explained]:
    """Every model of a disturbance that these scans can bear."""
    for one in (
        moved(case),
        tcp(case, null),
        drift(case, null),
        loose(case, null),
        kinematics(case, null),
        scaled(case, null),
    ):
        if one is not None:
            yield one


def moved(case: DoctorCase) -> Explained | None:
    """One camera pose before a scan and another one from it on."""
    n = case.n
    if n < 2 * LEAST_PART + 1:
        return None
    order = np.argsort(case.clock, kind="stable")
    place = np.empty(n, dtype=int)
    place[order] = np.arange(n)
    best: tuple[float, int, CauseFit] | None = None
    for k in range(LEAST_PART, n - LEAST_PART + 1):
        one = fit(case, groups=(place >= k).astype(int))
        if best is None or one.bic < best[0]:
            best = one.bic, k, one
    assert best is not None
    bic, k, one = best
    after = case.b @ (one.R[1] @ one.R[0].T).T + one.p[1] - one.R[1] @ one.R[0].T @ one.p[0]
    shift = np.linalg.norm(after - case.b, axis=1)
    turn = float(np.linalg.norm(log_rotation((one.R[1] @ one.R[0].T)[None])[0]))
    ids = (case.ids[order[k - 1]], case.ids[order[k]])
    numbers = {
        "shift_mm": 1e3 * float(np.sqrt((shift**2).mean())),
        "turn_deg": float(np.degrees(turn)),
        "index": float(k),
    }
    return Explained("scanner moved", bic + 2.0 * np.log(n), one, float(np.sqrt((shift**2).mean())), numbers, ids)


def tcp(case: DoctorCase, null: CauseFit) -> Explained | None:
    """Return a constant offset in the flange's frame."""
    D = -case.X_BF[:, :3, :3]
    if case.n < 5:
        return None
    starts = [null, *_tcp_starts(case, null)]
    one = min((fit(case, columns=D, start=s) for s in starts), key=lambda f: f.bic)
    straight = _faces_straight(
        case, min((fit(case, columns=D, start=s, normals=False) for s in starts), key=lambda f: f.rms)
    )
    bic = one.bic
    if straight is not None:  # a TCP that is turned as well: two numbers more
        turned = fit(straight, columns=D, start=one)
        if turned.bic + 2.0 * np.log(3.0 * case.n) < bic:
            one, bic = turned, turned.bic + 2.0 * np.log(3.0 * case.n)
    offset = -one.a  # the flange stands at this place in the frame that the poses name
    numbers = {f"tcp_{axis}_mm": 1e3 * float(v) for axis, v in zip("xyz", offset, strict=True)}
    return Explained("TCP set at the controller", bic, one, float(np.linalg.norm(one.a)), numbers)


def _faces_straight(case: DoctorCase, found: CauseFit) -> DoctorCase | None:
    """Return the case with the poses turned so that the scanned faces look along z.

    None where they do, or no normals were seen.
    """
    has = np.isfinite(case.m).all(axis=1)
    if has.sum() < 4:
        return None
    v = np.einsum("kji,kj->ki", case.X_BF[has][:, :3, :3], case.m[has] @ found.R[0].T)
    v = np.median(v, axis=0)
    length = float(np.linalg.norm(v))
    if length < 0.5 or v[2] > np.cos(_TURNED) * length:
        return None
    z = case.X_FR[:3, 2]
    axis = np.cross(z, v / length)
    angle = np.arctan2(np.linalg.norm(axis), float(z @ v) / length)
    R = exp_rotation(axis / max(float(np.linalg.norm(axis)), 1e-9) * angle)
    X_FR = case.X_FR.copy()
    X_FR[:3, :3] = R @ X_FR[:3, :3]
    return replace(case, X_FR=X_FR)


def _tcp_starts(case: DoctorCase, null: CauseFit) -> Iterator[CauseFit]:
    """Camera poses with the rotation's nine numbers free, so that an offset of any size is linear."""
    if case.n >= 6:
        R, p, offset = fit_with_offset(case.b, case.c, case.X_BF[:, :3, :3])
        yield replace(null, R=R[None], p=p[None], a=offset)


def scaled(case: DoctorCase, null: CauseFit) -> Explained:
    """Return the scanner's scale free of what is usual.

    Least squares along the undisturbed fit, then twice by the fit itself.
    """
    b, c = case.b - case.b.mean(axis=0), (case.c - case.c.mean(axis=0)) @ null.R[0].T
    ratio = float((b * c).sum() / max(float((c * c).sum()), 1e-12))
    for _ in range(2):
        ratio *= 1.0 + float(fit(replace(case, c=case.c * ratio)).scanner[0])
    one = fit(replace(case, c=case.c * ratio))
    numbers = {"percent": 1e2 * (ratio - 1.0)}
    return Explained("scanner scale error", one.bic + float(np.log(3.0 * case.n)), one, abs(ratio - 1.0), numbers)


def drift(case: DoctorCase, null: CauseFit) -> Explained | None:
    """The camera creeps with time, evenly or as a thing that warms up."""
    t = case.clock
    best: tuple[CauseFit, Array, str] | None = None
    arm = case.b - case.b.mean(axis=0)
    for tau in (None, 0.15, 0.4):
        f = t if tau is None else 1.0 - np.exp(-t / tau)
        f = f - f.mean()
        shift = np.eye(3)[None] * f[:, None, None]
        turned = np.concatenate([shift, -skew(arm) * f[:, None, None]], axis=2)
        for D in (shift, turned):
            one = fit(case, columns=D, start=null)
            if best is None or one.bic < best[0].bic:
                best = one, D, "even" if tau is None else f"{tau:g}"
    assert best is not None
    one, D, kind = best
    made = D @ one.a
    total = made[np.argmax(t)] - made[np.argmin(t)]
    numbers = {"drift_mm": 1e3 * float(np.linalg.norm(total)), "levels_off": 0.0 if kind == "even" else 1.0}
    return Explained(
        "warm-up drift", one.bic + 2.0 * np.log(3.0), one, float(np.sqrt((made**2).sum(axis=1).mean())), numbers
    )


def loose(case: DoctorCase, null: CauseFit) -> Explained | None:
    """Two states that the scans fall into in no order.

    An offset in the flange's frame, or of the camera, in some of them.
    """
    n = case.n
    if n < 8:
        return None
    best: tuple[float, CauseFit, Array, str] | None = None
    for frame, T in (("flange", -case.X_BF[:, :3, :3]), ("camera", np.broadcast_to(np.eye(3), (n, 3, 3)))):
        local = np.einsum("kji,kj->ki", T, null.e)
        spread = local - np.median(local, axis=0)
        axis = np.linalg.svd(spread, full_matrices=False)[2][0]
        for first in (
            (spread @ axis) > 0.0,
            np.linalg.norm(spread, axis=1) > np.median(np.linalg.norm(spread, axis=1)),
        ):
            found = _two_states(case, null, T, first)
            if found is not None and (best is None or found[0] < best[0]):
                best = (*found, frame)
    if best is None:
        return None
    bic, one, state, frame = best
    few = state if state.sum() <= n / 2 else np.logical_not(state)
    ids = tuple(np.array(case.ids)[few])
    numbers = {"jump_mm": 1e3 * float(np.linalg.norm(one.a)), "in_flange": float(frame == "flange")}
    return Explained("slack flange or loose mount", bic, one, float(np.linalg.norm(one.a)), numbers, ids)


def _two_states(case: DoctorCase, null: CauseFit, T: Array, state: Array) -> tuple[float, CauseFit, Array] | None:
    """Scans and states in turn until nothing changes (classification EM); None where one state has too few scans."""
    n = case.n
    least = max(3, int(np.ceil(_LEAST_SHARE * n)))
    one = null
    for _ in range(_STATES):
        if not least <= state.sum() <= n - least:
            return None
        one = fit(case, columns=T * state[:, None, None], start=one)
        bare = one.e - np.einsum("kij,j->ki", T, one.a) * state[:, None]
        other = bare + np.einsum("kij,j->ki", T, one.a)
        new = np.linalg.norm(other, axis=1) < np.linalg.norm(bare, axis=1)
        if (new == state).all():
            break
        state = new
    if not least <= state.sum() <= n - least:
        return None
    order = state[np.argsort(case.clock, kind="stable")]
    if np.count_nonzero(np.diff(order.astype(int))) <= 1:
        return None  # a move, not a play
    share = state.mean()
    labels = -2.0 * n * (share * np.log(share) + (1.0 - share) * np.log(1.0 - share))
    return one.bic + float(labels) + 2.0 * np.log(4.0), one, state


def _arm_of(case: DoctorCase) -> Chain | None:
    """Return the arm of a case; None where it is not known, or has too few scans to judge it by."""
    if not case.robot or case.n < FEWEST_FOR_ARM:
        return None
    try:
        return load_chain(case.robot)
    except InputError:
        return None


def kinematics(case: DoctorCase, null: CauseFit) -> Explained | None:
    """Other joint zeros and link lengths than those by which the poses were computed."""
    arm = _arm_of(case)
    if arm is None:
        return None
    best = another_arm(case, null, arm)
    bare = replace(case, arm=None)
    for q in joint_angles(case, arm):
        D, T, prior, names = _arm_columns(case, arm, q)
        one = fit(bare, columns=D, turning=T, prior=prior, start=null)
        if best is None or one.bic < best.bic:
            made = np.linalg.norm(D @ one.a - (D @ one.a).mean(axis=0), axis=1)
            worst = int(np.argmax(np.abs(one.a) * np.linalg.norm(D, axis=(0, 1))))
            numbers = {"largest_mm": 1e3 * float(made.max()), "worst": float(worst)}
            best = Explained(
                "wrong kinematics file", one.bic, one, float(np.sqrt((made**2).mean())), numbers, (names[worst],)
            )
    return best


def with_arm_errors(case: DoctorCase) -> DoctorCase:
    """Return the case with the errors of its arm as it leaves the factory.

    The branch of joint angles is the one that suits the scans best.
    """
    arm = _arm_of(case)
    if arm is None:
        return case
    best: tuple[float, DoctorCase] | None = None
    for q in joint_angles(case, arm):
        D, T, usual, _ = _arm_columns(case, arm, q)
        one = replace(
            case,
            arm=ArmDerivatives(
                D, T, usual * np.where(usual == _ZERO_RAD, FACTORY_RAD / _ZERO_RAD, FACTORY_M / _LENGTH_M)
            ),
        )
        bic = fit(one).bic
        if best is None or bic < best[0]:
            best = bic, one
    return case if best is None else best[1]


def another_arm(case: DoctorCase, null: CauseFit, arm: Chain) -> Explained | None:
    """Return the poses as another arm makes them from the same joint angles.

    None where no other arm explains the scans better.
    """
    best: Explained | None = None
    if null.rms < _ANOTHER_ARM_M or arm.name not in known_arms():
        return None
    others = [name for name in known_arms() if name != arm.name]
    for q in joint_angles(case, arm):
        for name in others:
            X_BF = chain_poses(load_chain(name), q)
            moved_m = float(np.median(np.linalg.norm(X_BF[:, :3, 3] - case.X_BF[:, :3, 3], axis=1)))
            if moved_m > _SIBLING_M:
                continue
            one = fit(case.with_poses(X_BF))
            bic = one.bic + 2.0 * np.log(8.0 * len(others))
            if bic < null.bic and (best is None or bic < best.bic):
                numbers = {"largest_mm": 1e3 * moved_m, "worst": 0.0}
                best = Explained("wrong kinematics file", bic, one, moved_m, numbers, (f"as of a {name.upper()}",))
    return best


def joint_angles(case: DoctorCase, arm: Chain) -> Iterator[Array]:
    """Joint angles (n, joints) for all poses, on each branch of the arm that reaches them all."""
    poses = [as_transform(X) for X in case.X_BF]
    answers = [inverse_kinematics(arm, X) for X in poses[: 1 if arm.n > len(LINKS) else None]]
    if any(len(a) == 0 for a in answers):
        return
    if len(answers) < len(poses):  # more than six joints: whole families, of which this follows one
        found = [nearest_solution(arm, X, answers[0][0]) for X in poses]
        if all(q is not None for q in found):
            yield np.array(found)
        return
    for seed in answers[0]:
        yield np.array([a[np.argmin(np.abs(np.angle(np.exp(1j * (a - seed)))).sum(axis=1))] for a in answers])


def _arm_columns(case: DoctorCase, arm: Chain, q: Array) -> tuple[Array, Array, Array, tuple[str, ...]]:
    """Differentiate the feature's centre and normal (n, 3, p) by joint zeros and link lengths.

    Those that only move base or flange are left out. Also returns one sigma (p,) of those numbers between two files of
    one arm, and their names.
    """
    poses = chain_poses(arm, q)
    made: list[Array] = []
    sigma: list[float] = []
    names: list[str] = []

    def add(changed: Array, step: float, usual: float, name: str) -> None:
        made.append((changed - poses) / step)
        sigma.append(usual)
        names.append(name)

    for j in range(1, arm.n - 1):
        step = np.zeros(arm.n)
        step[j] = _STEP_RAD
        add(chain_poses(arm, q + step), _STEP_RAD, _ZERO_RAD, f"the zero of joint {j + 1}")
    for j in range(1, arm.n):
        along = arm.stack[j, :3, 3]
        length = float(np.linalg.norm(along))
        if length < 1e-3 or (j == arm.n - 1 and abs(float(along @ arm.stack[j, :3, 2])) > 0.99 * length):
            continue  # along the last axis: a TCP
        stack = arm.stack.copy()
        stack[j, :3, 3] += _STEP_M * along / length
        add(chain_poses(replace(arm, stack=stack), q), _STEP_M, _LENGTH_M, f"the length of link {j}")
    change = np.stack(made, axis=-1) @ np.eye(len(made))
    D = np.einsum("kijp,j->kip", change[:, :3, :3], case.X_FR[:3, 3]) + change[:, :3, 3]
    return -D, np.einsum("kijp,j->kip", change[:, :3, :3], case.X_FR[:3, 2]), np.array(sigma), tuple(names)
