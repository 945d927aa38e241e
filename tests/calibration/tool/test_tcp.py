"""`weldcal tool tcp`: the TCP from touches as people store them, its region, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from weldcal.calibration.errors import ToolNotFound
from weldcal.calibration.tool.wire import WireTouch, find_tcp
from weldcal.tools.cli.app import app

TCP_MM = np.array([12.0, -35.0, 241.0])

# four points of a pendant in mm and degrees (forum.universal-robots.com 23542); the pendant said 5.25, 95.13, 308.52
UR_POINTS = """x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg
65.7,-784.16,291.58,169.71,12.32,48.59
378.39,-769.23,313.14,172.17,4.70,-42.69
341.84,-861.45,349.34,183.17,-42.86,-22.52
208.6,-640.97,253.82,145.56,19.65,-4.07
"""


def touched(
    rng: np.random.Generator, n: int, tilt_deg: float = 35.0, noise_mm: float = 0.1, axis: tuple[float, ...] = ()
) -> np.ndarray:
    """Flange poses (n, 4, 4), mm, at touches of one point; with an axis the tool only turns about it."""
    point, X = np.array([520.0, -140.0, 80.0]), np.tile(np.eye(4), (n, 1, 1))
    for k in range(n):
        turn = rng.uniform(-tilt_deg, tilt_deg, 3) if not axis else rng.uniform(-60, 60) * np.array(axis)
        R = Rotation.from_euler("x", 180, degrees=True) * Rotation.from_rotvec(np.radians(turn))
        X[k, :3, :3], X[k, :3, 3] = R.as_matrix(), point - R.apply(TCP_MM) + noise_mm * rng.standard_normal(3)
    return X


def touches_of(X: np.ndarray) -> list[WireTouch]:
    return [
        WireTouch(str(k + 1), RigidTransform(RotationMatrix.ProjectToRotationMatrix(x[:3, :3]), 1e-3 * x[:3, 3]))
        for k, x in enumerate(X)
    ]


def called(*words: object) -> tuple[int, dict[str, Any], str]:
    found = CliRunner().invoke(app, ["tool", "tcp", *(str(w) for w in words), "--json"])
    lines = [line for line in found.stdout.splitlines() if line.startswith("{")]
    return found.exit_code, json.loads(lines[-1]) if lines else {}, " ".join(found.stderr.split())


def ur_list(X: np.ndarray) -> str:
    v = Rotation.from_matrix(X[:, :3, :3]).as_rotvec()
    return "".join(f"p[{', '.join(f'{a:.6f}' for a in (*1e-3 * x[:3, 3], *w))}]\n" for x, w in zip(X, v, strict=True))


def kuka_csv(X: np.ndarray) -> str:
    abc = Rotation.from_matrix(X[:, :3, :3]).as_euler("ZYX", degrees=True)
    return "X,Y,Z,A,B,C\n" + "".join(
        ",".join(f"{a:.3f}" for a in (*x[:3, 3], *w)) + "\n" for x, w in zip(X, abc, strict=True)
    )


def fanuc_csv(X: np.ndarray) -> str:
    wpr = Rotation.from_matrix(X[:, :3, :3]).as_euler("xyz", degrees=True)
    return "x_mm,y_mm,z_mm,w_deg,p_deg,r_deg\n" + "".join(
        ",".join(f"{a:.3f}" for a in (*x[:3, 3], *w)) + "\n" for x, w in zip(X, wpr, strict=True)
    )


def abb_quaternions(X: np.ndarray) -> str:
    q = Rotation.from_matrix(X[:, :3, :3]).as_quat(scalar_first=True)
    return "x,y,z,q1,q2,q3,q4\n" + "".join(
        ",".join(f"{a:.6f}" for a in (*x[:3, 3], *w)) + "\n" for x, w in zip(X, q, strict=True)
    )


def matrices_json(X: np.ndarray) -> str:
    return json.dumps([x.tolist() for x in X])


def unnamed_degrees(X: np.ndarray) -> str:
    """No header: mm and fixed-axes angles in degrees, which other conventions fit as well by their form."""
    rpy = Rotation.from_matrix(X[:, :3, :3]).as_euler("xyz", degrees=True)
    return "".join(" ".join(f"{a:.4f}" for a in (*x[:3, 3], *w)) + "\n" for x, w in zip(X, rpy, strict=True))


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("touches.txt", ur_list),
        ("touches.csv", kuka_csv),
        ("touches.csv", fanuc_csv),
        ("touches.csv", abb_quaternions),
        ("touches.json", matrices_json),
        ("touches.txt", unnamed_degrees),
    ],
)
def test_touches_of_every_form_give_the_tcp(tmp_path: Path, name: str, write: Any) -> None:
    (tmp_path / name).write_text(write(touched(np.random.default_rng(1), 8)))
    code, found, said = called(tmp_path / name, "--out", tmp_path / "out")
    assert code == 0, said
    assert found["tcp_mm"] == pytest.approx(TCP_MM, abs=0.5)
    assert (tmp_path / "out" / "set_tcp.script").read_text().startswith("set_tcp(p[0.01")
    assert (tmp_path / "out" / "report.html").is_file()


def test_the_pendants_four_points_give_least_squares(tmp_path: Path) -> None:
    (tmp_path / "ur.csv").write_text(UR_POINTS)
    _, found, _ = called(tmp_path / "ur.csv", "--out", tmp_path / "out")
    assert found["tcp_mm"] == pytest.approx([6.1, 92.5, 307.3], abs=0.06)
    assert min(found["residual_mm"]) == pytest.approx(0.9, abs=0.1)
    assert max(found["residual_mm"]) == pytest.approx(3.1, abs=0.1)
    assert found["error_95_mm"] > 2.0
    assert all(v > 2.0 for v in found["held_out_mm"])


def test_a_limit_is_judged(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text(ur_list(touched(np.random.default_rng(2), 10)))
    for limit, verdict in ((1.0, "use it"), (0.05, "do not use")):
        run = CliRunner().invoke(
            app,
            ["tool", "tcp", str(tmp_path / "t.txt"), "--limit-mm", str(limit), "--out", str(tmp_path / f"o{limit}")],
        )
        assert f"tool tcp: {verdict}\n" in run.output


def test_the_region_is_neither_wide_nor_narrow() -> None:
    rng = np.random.default_rng(5)
    for n, share in ((4, 300), (8, 300)):
        inside, squares = [], []
        for _ in range(share):
            found = find_tcp(touches_of(touched(rng, n))).wire
            e = found.p_FW - 1e-3 * TCP_MM
            squares.append(float(e @ np.linalg.solve(found.covariance, e)))
            inside.append(squares[-1] < 7.815)
        # 0.95 +- four binomial sigmas; the touches that F leaves out by chance cost less
        assert 0.90 < np.mean(inside) < 0.995, n
        assert 0.25 < np.median(squares) / 2.366 < 1.25, n


def test_orientations_too_alike_are_refused_with_advice() -> None:
    with pytest.raises(ToolNotFound, match=r"largest turn between two touches is \d\.\d degrees.*Tilt the tool"):
        find_tcp(touches_of(touched(np.random.default_rng(3), 6, tilt_deg=1.0)))
    with pytest.raises(ToolNotFound, match=r"along \(0\.00, 0\.00, 1\.00\) of the flange"):
        find_tcp(touches_of(touched(np.random.default_rng(3), 6, axis=(0.0, 0.0, 1.0))))


def test_a_touch_that_slipped_is_named(tmp_path: Path) -> None:
    X = touched(np.random.default_rng(4), 8)
    X[5, :3, 3] += [0.0, 4.0, 0.0]
    (tmp_path / "t.csv").write_text(fanuc_csv(X))
    _, found, _ = called(tmp_path / "t.csv", "--out", tmp_path / "out")
    assert found["worst_touch"] == "6"
    assert found["left_out"] == ["6"]
    assert found["tcp_mm"] == pytest.approx(TCP_MM, abs=0.4)
    assert found["held_out_mm"][5] == pytest.approx(4.0, abs=0.6)


def test_touches_of_two_points_are_refused(tmp_path: Path) -> None:
    X = touched(np.random.default_rng(6), 8)
    X[::2, :3, 3] += [60.0, 0.0, 0.0]
    (tmp_path / "t.csv").write_text(fanuc_csv(X))
    code, _, said = called(tmp_path / "t.csv", "--out", tmp_path / "out")
    assert code == 1
    assert "all are of one point" in said


def test_three_touches_are_too_few(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text(ur_list(touched(np.random.default_rng(7), 3)))
    code, _, said = called(tmp_path / "t.txt", "--out", tmp_path / "out")
    assert code == 1
    assert "touch in four orientations or more" in said


def test_a_set_tcp_is_taken_off_and_its_turn_kept(tmp_path: Path) -> None:
    X = touched(np.random.default_rng(8), 8)
    old = np.eye(4)
    old[:3, :3], old[:3, 3] = Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix(), [0.0, 0.0, 200.0]
    (tmp_path / "t.txt").write_text(ur_list(X @ old))
    _, found, _ = called(tmp_path / "t.txt", "--tcp", "0,0,200,0,0.3,0", "--out", tmp_path / "out")
    assert found["tcp_mm"] == pytest.approx(TCP_MM, abs=0.4)
    assert found["set_tcp"].endswith("0.000000, 0.300000, 0.000000])")
    assert np.allclose(np.array(found["X_FT"])[:3, :3], old[:3, :3])


def test_touches_that_fit_no_point_are_a_concern(tmp_path: Path) -> None:
    noisy, good = tmp_path / "noisy.txt", tmp_path / "good.txt"
    noisy.write_text(ur_list(touched(np.random.default_rng(2), 6, noise_mm=8.0)))
    good.write_text(ur_list(touched(np.random.default_rng(2), 6, noise_mm=0.5)))
    found = [called(file, "--out", file.with_suffix(""))[1]["first_screen"]["could_be_wrong"] for file in (noisy, good)]
    assert "from the point of the others: repeat the touches" in " ".join(found[0])
    assert found[1] == []
