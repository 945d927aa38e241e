"""A profiler on a flange, calibrated by one straight edge: the paper's method and the joint one, and what both
refuse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.places import SHARED_DATA, needs
from tests.worlds.edge_trials import edge_crb
from weldcal.calibration.errors import (
    DegenerateMotion,
    FeatureNotFound,
    InconsistentData,
    TooFewRotations,
    TooFewTranslations,
)
from weldcal.calibration.profiler.edge.features import extract_edge
from weldcal.calibration.profiler.edge.joint import EdgeEstimate, edge_joint
from weldcal.calibration.profiler.edge.linear import edge_linear
from weldcal.calibration.profiler.edge.model import EdgeState, predicted
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.models.errors import InputError

DATA = SHARED_DATA / "profiler"
MM = 1e-3
SIGMA_ROBOT, SIGMA_XZ = 0.03 * MM, (0.05 * MM, 0.06 * MM)
needs_data = needs(DATA)

TRUTH = EdgeState(
    Rotation.from_euler("xyz", [170.0, -9.0, 52.0], degrees=True).as_matrix(),
    np.array([0.055, 0.021, 0.130]),
    np.array([0.9, -0.2, 0.25]),
    np.array([0.8, 0.58, 0.15]) / np.linalg.norm([0.8, 0.58, 0.15]),
)


@dataclass(frozen=True)
class Views:
    """Poses (n, ...) in which the edge crosses the scan plane, and where."""

    rotation: np.ndarray
    translation: np.ndarray
    points: np.ndarray


def views(count: int, rng: np.random.Generator, *, noise: float = 1.0, turn_deg: float = 35.0) -> Views:
    """Any poses with the edge between 60 and 90 mm off, and nowhere along the scan plane."""
    above = np.column_stack([np.cross(TRUTH.direction, [0.0, 0.0, -1.0]), np.zeros(3), [0.0, 0.0, -1.0]])
    above[:, 0] /= np.linalg.norm(above[:, 0])
    above[:, 1] = np.cross(above[:, 2], above[:, 0])
    R, t = [], []
    while len(R) < count:
        turn = Rotation.from_euler("xyz", rng.uniform(-1, 1, 3) * [turn_deg, turn_deg, 1.7 * turn_deg], degrees=True)
        R_BS = above @ turn.as_matrix()
        if abs(TRUTH.direction @ R_BS[:, 1]) < 0.45:
            continue
        p_S = np.array([rng.uniform(-0.018, 0.018), 0.0, rng.uniform(0.06, 0.09)])
        R_BF = R_BS @ TRUTH.rotation.T
        R.append(R_BF)
        at = TRUTH.point + rng.uniform(-0.07, 0.07) * TRUTH.direction
        t.append(at - R_BF @ (TRUTH.rotation @ p_S + TRUTH.translation))
    rotation, translation = np.array(R), np.array(t)
    points = predicted(TRUTH, FlangePoses(rotation, translation))[0]
    measured = points + noise * rng.standard_normal(points.shape) * SIGMA_XZ
    return Views(rotation, translation + noise * SIGMA_ROBOT * rng.standard_normal(translation.shape), measured)


def solved(v: Views, init: EdgeState | None = None) -> EdgeEstimate:
    return edge_joint(v.rotation, v.translation, v.points, sigma_robot_m=SIGMA_ROBOT, sigma_xz_m=SIGMA_XZ, init=init)


def off(rotation: np.ndarray, translation: np.ndarray, truth: EdgeState = TRUTH) -> np.ndarray:
    """(6,) rotation vector in F and translation from the estimate to the truth."""
    turn = Rotation.from_matrix(truth.rotation @ rotation.T).as_rotvec()
    return np.concatenate([turn, truth.translation - translation])


def test_without_noise_and_without_a_guess_the_answer_is_exact() -> None:
    error = off(*(lambda e: (e.rotation, e.translation))(solved(views(20, np.random.default_rng(1), noise=0.0))))
    assert np.abs(error).max() < 1e-10


def test_the_jacobian_is_that_of_the_prediction() -> None:
    v = views(5, np.random.default_rng(2))
    poses = FlangePoses(v.rotation, v.translation)
    _, J, by_robot = predicted(TRUTH, poses)
    h = 1e-6
    for k in range(10):
        step = np.eye(10)[k] * h
        found = (predicted(TRUTH.moved(step), poses)[0] - predicted(TRUTH.moved(-step), poses)[0]) / (2.0 * h)
        np.testing.assert_allclose(J[:, :, k], found, atol=1e-7)
    for k in range(3):
        step = np.eye(3)[k] * h
        ahead = predicted(TRUTH, FlangePoses(v.rotation, v.translation + step))[0]
        back = predicted(TRUTH, FlangePoses(v.rotation, v.translation - step))[0]
        np.testing.assert_allclose(by_robot[:, :, k], (ahead - back) / (2.0 * h), atol=1e-7)


def test_its_covariance_is_what_it_scatters_by_and_the_bound() -> None:
    runs = [views(30, np.random.default_rng([3, k])) for k in range(40)]
    nees, size, bound = [], [], []
    for v in runs:
        estimate = solved(v, TRUTH)  # where it starts is another test's matter
        error = off(estimate.rotation, estimate.translation)
        nees.append(error @ np.linalg.solve(estimate.covariance, error))
        size.append(error[3:] @ error[3:])
        crb = edge_crb(TRUTH, v.rotation, v.translation, sigma_robot_m=SIGMA_ROBOT, sigma_xz_m=SIGMA_XZ)
        bound.append(np.trace(crb[3:, 3:]))
    # 40 draws of chi-square with 6 degrees: mean 6, sigma sqrt(12/40) = 0.55; a Cauchy loss costs up to a tenth
    assert 6.0 - 3 * 0.55 < np.mean(nees) < 6.6 + 3 * 0.55
    # sums of squares of 40 x (mostly one) degree of freedom scatter by sqrt(2/40) = 0.22
    assert 1.0 - 3 * 0.22 < np.sum(size) / np.sum(bound) < 1.1 + 3 * 0.22


def test_a_tenth_of_wrong_points_is_named_and_does_no_harm() -> None:
    rng = np.random.default_rng(4)
    v = views(80, rng)
    wrong = rng.random(80) < 0.1
    v.points[wrong, 0] += rng.choice([-1.0, 1.0], wrong.sum()) * rng.uniform(1.0, 8.0, wrong.sum()) * MM
    estimate = solved(v)
    assert (estimate.inliers == ~wrong).all()
    error = off(estimate.rotation, estimate.translation)
    assert error @ np.linalg.solve(estimate.covariance, error) < 22.5  # 1 in 1000 of chi-square with 6 degrees


@pytest.mark.parametrize(("kept", "names"), [("one axis", "translation along"), ("one rotation", "translation along")])
def test_a_motion_that_leaves_something_open_is_refused_by_name(kept: str, names: str) -> None:
    rng = np.random.default_rng(5)
    v = views(20, rng)
    axis = TRUTH.rotation[:, 2]  # of the scanner, in F
    angles = rng.uniform(-0.8, 0.8, 20) if kept == "one axis" else np.zeros(20)
    R = np.array([v.rotation[0] @ Rotation.from_rotvec(a * axis).as_matrix() for a in angles])
    points = predicted(TRUTH, FlangePoses(R, v.translation))[0]
    with pytest.raises(DegenerateMotion, match=names):
        solved(Views(R, v.translation, points + rng.standard_normal(points.shape) * SIGMA_XZ))


@pytest.mark.parametrize("kind", ["five poses repeated", "turns of half a degree", "one place of the laser line"])
def test_where_another_mounting_explains_the_points_as_well_it_says_so(kind: str) -> None:
    rng = np.random.default_rng(16)
    v = views(40, rng, turn_deg=0.5 if kind.startswith("turns") else 35.0)
    R, t = v.rotation, v.translation
    if kind.startswith("five"):
        R, t = np.repeat(R[:5], 8, axis=0), np.repeat(t[:5], 8, axis=0)
    if kind.startswith("one"):
        at = TRUTH.point + rng.uniform(-0.05, 0.05, (40, 1)) * TRUTH.direction
        t = at - R @ (TRUTH.rotation @ [0.0, 0.0, 0.075] + TRUTH.translation)
    points = predicted(TRUTH, FlangePoses(R, t))[0]
    points = points + rng.standard_normal(points.shape) * SIGMA_XZ
    with pytest.raises(DegenerateMotion, match=r"deg apart, explain these points alike|leave the"):
        solved(Views(R, t + SIGMA_ROBOT * rng.standard_normal(t.shape), points))
    with pytest.raises((DegenerateMotion, TooFewTranslations)):
        edge_linear(R, t, points)


def test_it_finds_a_profiler_mounted_anyhow() -> None:
    rng = np.random.default_rng(17)
    for k in range(8):
        turn = Rotation.random(random_state=k).as_matrix()
        v = views(15, rng)
        # the flange turned by any rotation: the same scans of a profiler that is mounted otherwise
        truth = EdgeState(turn @ TRUTH.rotation, turn @ TRUTH.translation, TRUTH.point, TRUTH.direction)
        e = solved(Views(v.rotation @ turn.T, v.translation, v.points))
        error = off(e.rotation, e.translation, truth)
        assert error @ np.linalg.solve(e.covariance, error) < 27.9  # 1 in 10 000 of chi-square with 6 degrees


def test_points_of_two_edges_are_not_taken_for_one() -> None:
    rng = np.random.default_rng(6)
    v = views(40, rng)
    other = EdgeState(
        TRUTH.rotation, TRUTH.translation, TRUTH.point + np.array([0.012, -0.005, 0.0]), np.array([0.6, 0.78, 0.15])
    )
    v.points[20:] = predicted(other, FlangePoses(v.rotation[20:], v.translation[20:]))[0]
    with pytest.raises(InconsistentData, match="one edge"):
        solved(v)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda v: Views(v.rotation[:5], v.translation[:5], v.points[:5]), "too few"),
        (lambda v: Views(v.rotation * 1.001, v.translation, v.points), "rotation of pose 0"),
        (lambda v: Views(v.rotation, np.full_like(v.translation, np.nan), v.points), "not finite"),
        (lambda v: Views(v.rotation, v.translation, v.points[:-1]), "20 profile points"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(change: object, text: str) -> None:
    with pytest.raises((InputError, TooFewTranslations), match=text):
        solved(change(views(20, np.random.default_rng(7))))  # type: ignore[operator]


@needs_data
@pytest.mark.parametrize(
    ("name", "paper", "joint"),
    [
        ("grid_xy_paper", (1.466, 1.679), (0.39, 0.50)),
        ("grid_tilt_nominal", (0.201, 0.230), (0.107, 0.132)),
        ("outlier10_nominal", (7.26, 9.33), (0.071, 0.095)),
        ("free40_paper", None, (0.36, 0.42)),
    ],
)
def test_on_the_fixed_files_the_paper_is_reproduced_and_the_joint_method_keeps_its_targets(
    name: str, paper: tuple[float, float] | None, joint: tuple[float, float]
) -> None:
    data = np.load(DATA / "edge_features.npz")
    truth = EdgeState(data["truth_Rs"], data["truth_Ts"] * MM, data["truth_p0"] * MM, data["truth_e"])
    sigma = data["sigma_paper" if name.endswith("paper") else "sigma_nominal"] * MM
    R, t, p = data[f"{name}_Rb"], data[f"{name}_Tb"] * MM, data[f"{name}_ps"] * MM
    ours, theirs = [], []
    for k in range(len(R)):
        e = edge_joint(R[k], t[k], p[k], sigma_robot_m=sigma[0], sigma_xz_m=sigma[1:])
        ours.append(off(e.rotation, e.translation, truth))
        if name.startswith("outlier"):
            assert (e.inliers == ~data[f"{name}_outlier"][k]).all()
        if paper is not None:
            lin = edge_linear(R[k], t[k], p[k], data[f"{name}_group"][k])
            theirs.append(off(lin.rotation, lin.translation, truth))
    assert np.all(np.array(_rms(ours)) <= joint)
    if paper is not None:
        assert _rms(theirs) == pytest.approx(paper, rel=2e-3)


def _rms(errors: list[np.ndarray]) -> tuple[float, float]:
    e = np.array(errors)
    turn, shift = np.sqrt((e[:, :3] ** 2).sum(axis=1).mean()), np.sqrt((e[:, 3:] ** 2).sum(axis=1).mean())
    return float(np.degrees(turn)), float(shift / MM)


@needs_data
@pytest.mark.parametrize(
    ("name", "refusal"),
    [
        ("degen_collinear", DegenerateMotion),
        ("degen_along_edge", DegenerateMotion),
        ("degen_one_rotation", TooFewRotations),
        ("degen_two_rotations", TooFewRotations),
        ("degen_one_axis", DegenerateMotion),
        ("degen_two_edges", InconsistentData),
    ],
)
def test_the_papers_method_is_kept_from_answering_where_it_cannot(name: str, refusal: type[Exception]) -> None:
    data = np.load(DATA / "edge_features.npz")
    for k in range(len(data[f"{name}_Rb"])):
        with pytest.raises(refusal):
            edge_linear(data[f"{name}_Rb"][k], data[f"{name}_Tb"][k] * MM, data[f"{name}_ps"][k] * MM)


@needs_data
@pytest.mark.parametrize(
    ("kind", "name", "limits"),
    [("bar", "bar", (0.050, 0.031)), ("step", "scale", (0.053, 0.031)), ("apex", "blade", (0.006, 0.012))],
)
def test_the_edge_is_found_in_every_raw_profile(kind: str, name: str, limits: tuple[float, float]) -> None:
    data = np.load(DATA / "edge_profiles.npz")
    errors = []
    for profile, truth in zip(data[f"{name}_prof"], data[f"{name}_truth"], strict=True):
        point, _ = extract_edge(profile * MM, kind)  # type: ignore[arg-type]
        mirrored, _ = extract_edge(profile[::-1] * [-MM, MM], kind, "right")  # type: ignore[arg-type]
        assert mirrored == pytest.approx(point * [-1.0, 1.0], abs=0.02 * MM)  # of a pitch of 0.16 mm
        errors.append(point / MM - truth)
    assert (np.std(errors, axis=0) <= limits).all()


def test_a_flat_profile_has_no_edge() -> None:
    x = np.linspace(-0.02, 0.02, 200)
    flat = np.column_stack([x, np.full(200, 0.07)])
    for kind in ("bar", "step", "apex"):
        with pytest.raises(FeatureNotFound):
            extract_edge(flat, kind)  # type: ignore[arg-type]
    with pytest.raises(FeatureNotFound, match="returns only"):
        extract_edge(np.full((200, 2), np.nan), "bar")
