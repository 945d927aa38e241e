"""Profile sets by ray casting alone, with z as distances and as heights: right, refused or wrong, counted.

A part is a profile of corners that one straight direction sweeps. Each ray of the sensor ends where it first meets the
part. Nothing here is of weldcal but the command that is tried.

    python -m tests.calibration.profiler.height_sets --sets 400
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from weldcal.tools.cli.app import app

# corners (u, v) mm of each part's profile, v up, and the line that is sought: place of its corner by the side
FLAT = 150.0
PARTS: dict[str, list[tuple[float, float]]] = {
    "bar": [(-FLAT, -18.0), (-9.0, -18.0), (-9.0, 0.0), (9.0, 0.0), (9.0, -18.0), (FLAT, -18.0)],
    "step": [(-FLAT, -3.0), (0.0, -3.0), (0.0, 0.0), (FLAT, 0.0)],
    "ridge": [(-FLAT, -86.6), (0.0, 0.0), (FLAT, -86.6)],
    "roof": [(-FLAT, -12.0), (-16.0, -12.0), (0.0, 0.0), (16.0, -12.0), (FLAT, -12.0)],
    "groove": [(-FLAT, 0.0), (-7.0, 0.0), (0.0, -12.0), (7.0, 0.0), (FLAT, 0.0)],
}
FEATURE = {"bar": "bar", "step": "step", "ridge": "apex", "roof": "apex"}
RAYS, HALF_ANGLE = 360, 0.19  # of the fan, rad
GRAZING = np.cos(np.radians(80.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfileSet:
    """One set: profiles [x, z] mm, flange poses, the truth, and what was drawn."""

    part: str
    heights: bool
    side: str
    profiles: list[np.ndarray]
    X_BF: np.ndarray
    X_FS: np.ndarray  # in the frame of the file
    root: np.ndarray  # a point and the direction of the groove's root
    noise: float


def _rigid(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, t
    return X


def _cast(corners: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Length to the first wall along rays (n, 3) from an origin in the part's frame; NaN; cosine of the incidence.

    The part's frame has u and v in its profile and w along the sweep.
    """
    a, b = corners[:-1], corners[1:]
    along = b - a
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.einsum("kj,kj->k", normal, a - origin[:2])[None] / (rays[:, :2] @ normal.T)
        at = origin[:2] + t[:, :, None] * rays[:, None, :2]
        s = np.einsum("nkj,kj->nk", at - a, along) / (along**2).sum(axis=1)
    t = np.where((t > 0.0) & (s >= 0.0) & (s <= 1.0), t, np.inf)
    wall = np.argmin(t, axis=1)
    first = t[np.arange(len(rays)), wall]
    facing = np.abs((rays[:, :2] * normal[wall]).sum(axis=1)) / np.linalg.norm(rays, axis=1)
    return np.where(np.isfinite(first), first, np.nan), facing


def profile_set(rng: np.random.Generator, part: str, heights: bool, views: int = 0) -> ProfileSet:
    """Draw a mounting, a place of the part and poses about it, and cast the rays."""
    n = views or int(rng.integers(12, 31))
    X_FS = _rigid(Rotation.random(random_state=rng).as_matrix(), rng.uniform([-80, -80, 60], [80, 80, 200]))
    sweep = Rotation.from_euler("zxy", [rng.uniform(0, 360), *rng.uniform(-8, 8, 2)], degrees=True)
    # columns u, v, w: v is up
    R_BO = sweep.as_matrix() @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    X_BO = _rigid(R_BO, rng.uniform([400, -400, 0], [900, 400, 300]))
    side = str(rng.choice(["left", "right"])) if part in ("bar", "step") else "left"
    noise, tilt = float(rng.choice([0.01, 0.03, 0.08])), float(rng.uniform(12, 26))
    zero = float(rng.choice([190.0, 250.0, 320.0]))  # distance at which a height is 0
    even = bool(rng.random() < 0.5)
    corners = np.array(PARTS[part])
    mirrored = part == "step" and side == "right"  # the near face ends at the stated side
    if mirrored:
        corners = (corners * [-1.0, 1.0])[::-1]
    edge_u = {"bar": -9.0 if side == "left" else 9.0}.get(part, 0.0)
    profiles: list[np.ndarray] = []
    poses: list[np.ndarray] = []
    while len(profiles) < n:
        # the sensor above the edge: x along u, z down, then tilted, and turned about its view
        look = Rotation.from_euler("xyz", [*rng.uniform(-tilt, tilt, 2), rng.uniform(-35, 35)], degrees=True)
        R_OS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]) @ look.as_matrix()
        aim = np.array([edge_u + rng.uniform(-8, 8), 0.0, rng.uniform(-60, 60)])
        origin = aim - rng.uniform(170.0, 290.0) * R_OS[:, 2]
        angles = np.linspace(-HALF_ANGLE, HALF_ANGLE, RAYS)
        fan = np.column_stack([np.tan(angles), np.zeros(RAYS), np.ones(RAYS)])
        z, facing = _cast(corners, origin, fan @ R_OS.T)
        z = np.where((facing > GRAZING) & (z < 400.0), z, np.nan)
        p = np.column_stack([fan[:, 0] * z, z + noise * rng.standard_normal(RAYS)])
        p[rng.random(RAYS) < 0.01] = np.nan
        spikes = rng.random(RAYS) < 0.004
        p[spikes, 1] += rng.uniform(-15, 15, spikes.sum())
        if even:  # bins of one width, as uniform spacing gives
            good = p[np.isfinite(p[:, 1])]
            step = 0.3
            bins = np.round(good[:, 0] / step).astype(int)
            p = np.array([[k * step, np.median(good[bins == k, 1])] for k in np.unique(bins)])
        if heights:
            p[:, 1] = zero - p[:, 1]
        if rng.random() < 0.08:  # this profile looks past the part
            p[:, 1] = np.nanmedian(p[:, 1]) + noise * rng.standard_normal(len(p))
        profiles.append(np.round(p, 4))
        X = X_BO @ _rigid(R_OS, origin) @ np.linalg.inv(X_FS)
        X[:3, 3] += 0.02 * rng.standard_normal(3)
        poses.append(X)
    frame = _rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, zero])) if heights else np.eye(4)
    root = X_BO @ np.array([[0.0, 0.0], [-12.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    return ProfileSet(
        part=part, heights=heights, side=side, profiles=profiles, X_BF=np.array(poses), X_FS=X_FS @ frame,
        root=root[:3].T, noise=noise,
    )  # fmt: skip


def _called(*words: object) -> tuple[dict[str, Any], str]:
    found = CliRunner().invoke(app, ["profiler", *(str(w) for w in words), "--json"])
    lines = [line for line in found.stdout.splitlines() if line.startswith("{")]
    return (json.loads(lines[-1]) if found.exit_code == 0 and lines else {}), " ".join(found.stderr.split())


def write_folder(made: ProfileSet, folder: Path) -> Path:
    """One file for each profile, and the flange's poses as quaternions in mm."""
    folder.mkdir(parents=True)
    for k, p in enumerate(made.profiles):
        (folder / f"p{k + 1:02d}.txt").write_text(
            "".join(f"{x:.4f} {z:.4f}\n" for x, z in p if np.isfinite([x, z]).all())
        )
    q = Rotation.from_matrix(made.X_BF[:, :3, :3]).as_quat(scalar_first=True)
    rows = [",".join(f"{v:.9f}" for v in (*X[:3, 3], *w)) for X, w in zip(made.X_BF, q, strict=True)]
    (folder / "robot_poses.csv").write_text("x_mm,y_mm,z_mm,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    return folder


def tried(made: ProfileSet, folder: Path, *more: object) -> tuple[str, str]:
    """Verdict and words of one set.

    right: within 0.5 mm and 0.5 degrees, or 0.3 mm of the root. With the right sign wide: farther, and within four
    stated sigmas; off: beyond them, as with the sign stated. refused: a sentence. wrong: the wrong sign was taken.
    """
    files = write_folder(made, folder / "profiles")
    sign = "towards the sensor" if made.heights else "away from the sensor"
    if made.part == "groove":
        X = made.X_FS.copy()
        X[:3, 3] *= 1e-3
        (folder / "calibration").mkdir()
        (folder / "calibration" / "profiler.yaml").write_text(record_text(X))
        got, said = _called("seam", files, "--calibration", folder / "calibration", "--out", folder / "out", *more)
        if not got:
            return "refused", said
        rows = np.atleast_1d(np.genfromtxt(folder / "out" / "seam.csv", delimiter=",", names=True))
        p = np.column_stack([rows[f"root_{a}_mm"] for a in "xyz"])
        off = np.linalg.norm(np.cross(p - made.root[0], made.root[1]), axis=1)
        verdict = "right" if np.median(off) < 0.3 and np.percentile(off, 90) < 1.0 else "wrong"
        told = got.get("z_grows", "?")
        return (verdict if told == sign else "wrong"), f"{np.median(off):.3f} mm of {len(p)} points, z {told}"
    words = ["edge", files, "--feature", FEATURE[made.part], "--as", f"side={made.side}", "--out", folder / "out"]
    got, said = _called(*words, *more)
    if not got:
        return "refused", said
    X = np.array(got["X_FS"])
    z = float(np.nanmedian(np.concatenate([p[:, 1] for p in made.profiles])))
    middle = np.array([0.0, 0.0, z, 1.0])
    error = np.linalg.norm((1e3 * X[:3, 3] + X[:3, :3] @ middle[:3]) - (made.X_FS @ middle)[:3])
    turn = np.degrees(np.linalg.norm(Rotation.from_matrix(X[:3, :3] @ made.X_FS[:3, :3].T).as_rotvec()))
    told = got.get("z_grows", "")
    words_ = (
        f"{error:.3f} mm {turn:.3f} deg, sigma {got['sigma_translation_mm']:.3f} mm, z {told}, {got.get('z_reason')}"
    )
    if error < 0.5 and turn < 0.5:
        return "right", words_
    within = error < 4.0 * got["sigma_translation_mm"] and turn < 4.0 * got["sigma_rotation_deg"]
    return ("wrong" if told != sign else "wide" if within else "off"), words_


def record_text(X: np.ndarray) -> str:
    """A profiler.yaml with this X_FS (m) and nothing else."""
    return (
        f"schema: 1\nmethod: stated\nunits: m, rad\nX_FS: {{matrix: {X.tolist()}}}\n"
        "sensor: {x_scale_z_scale_shear: [0.0, 0.0, 0.0], origin: [0.0, 0.0]}\nfigures: {}\ndata_sha256: ''\n"
    )


def counted(sets: int, seed: int, show: bool = False) -> Counter[str]:
    """Verdicts of sets of each part in turn, with either sign of z in turn."""
    counts: Counter[str] = Counter()
    names = list(PARTS)
    for k in range(sets):
        part, heights = names[k % len(names)], (k // len(names)) % 2 == 1
        made = profile_set(np.random.default_rng([seed, k]), part, heights)
        with tempfile.TemporaryDirectory() as folder:
            verdict, words = tried(made, Path(folder))
        counts[f"{part:7s}{'heights' if heights else 'depths '} {verdict}"] += 1
        counts[verdict] += 1
        if show and verdict != "right":
            print(
                f"{k:4d} {part} {'heights' if heights else 'depths'} {made.side}: {verdict}: {words[:300]}", flush=True
            )
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    for name, n in sorted(counted(a.sets, a.seed, show=True).items()):
        print(f"{name:28s}{n:5d}")


if __name__ == "__main__":
    main()
