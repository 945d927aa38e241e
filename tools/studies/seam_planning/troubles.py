"""Troubles of seam planning: something in front of the part, things around it, and parts that are not the one drawn."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.bent_workpiece import bend
from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh
from weldcal.models.scanners import get_scanner
from weldcal.models.workpieces import Workpiece, make_workpiece
from weldcal.tools.studies.seam_planning.scenes import Scene, box, scan_part
from weldcal.tools.studies.seam_planning.trials import BEND_M, WIDEST_PX, try_cad, try_cloud

PRESET = "phoxi_m"
PLANNED, REFUSED = "planned", "refused"


@dataclass(frozen=True)
class Trouble:
    """A kind of scene. others: what else stands there; drawing: what is looked for, None: the part itself; must: what the
    answer has to be, empty where a plan with an honest sigma and a refusal are both right.
    """

    name: str
    part: Callable[[], Workpiece]
    must: str
    method: str
    others: Callable[[np.random.Generator], list[TriMesh]] = lambda rng: []
    drawing: Callable[[], Workpiece] | None = None


@dataclass(frozen=True)
class TroubleTrial:
    """One scan in one kind of trouble; lengths in mm, nan where it was refused. ok: the answer is what it has to be."""

    name: str
    method: str
    seed: int
    refused: str
    rms_mm: float
    worst_mm: float
    sigma_mm: float
    within_2_sigma: float
    ok: bool
    seconds: float


def _bar(width_m: float) -> Callable[[np.random.Generator], list[TriMesh]]:
    """A bar 60 mm over the part, across its middle."""

    def made(rng: np.random.Generator) -> list[TriMesh]:
        turn = RotationMatrix.MakeZRotation(rng.uniform(-math.pi, math.pi))
        p = [0.6 + rng.uniform(-0.02, 0.02), rng.uniform(-0.02, 0.02), 0.11]
        return [box(0.6, width_m, 0.01).transformed(RigidTransform(turn, p))]

    return made


def _clutter(rng: np.random.Generator) -> list[TriMesh]:
    """Boxes around the part, some as high as it, and one that stands on its edge."""
    meshes = []
    for _ in range(8):
        angle, far = rng.uniform(-math.pi, math.pi), rng.uniform(0.16, 0.32)
        X = RigidTransform(
            RotationMatrix.MakeZRotation(rng.uniform(-math.pi, math.pi)),
            [0.6 + far * math.cos(angle), far * math.sin(angle), 0.0],
        )
        size = rng.uniform([0.03, 0.03, 0.01], [0.12, 0.08, 0.08])
        meshes.append(box(*(float(v) for v in size)).transformed(X))
    return meshes


def _s() -> Workpiece:
    return make_workpiece("s", length_m=0.250)


def _bent(radius_m: float) -> Callable[[], Workpiece]:
    return lambda: bend(make_workpiece("s", length_m=0.200), radius_m)


TROUBLES = (
    *(
        Trouble(name, part, must, method, others)
        for name, part, must, others in (
            ("bar of 12 mm across", _s, PLANNED, _bar(0.012)),
            ("bar of 30 mm across", _s, "", _bar(0.030)),
            ("clutter around", _s, PLANNED, _clutter),
            ("bent, bar of 12 mm across", _bent(BEND_M), PLANNED, _bar(0.012)),
        )
        for method in ("cad", "cloud")
    ),
    Trouble(
        "wrong: 6 mm wider", lambda: make_workpiece("s", length_m=0.250, width_m=0.206), REFUSED, "cad", drawing=_s
    ),
    Trouble("wrong: 5 mm longer", lambda: make_workpiece("s", length_m=0.255), REFUSED, "cad", drawing=_s),
    Trouble(
        "wrong: another groove",
        lambda: make_workpiece("straight", length_m=_s().size_m[0]),
        REFUSED,
        "cad",
        drawing=_s,
    ),
    Trouble(
        "wrong: bent, drawn flat", _bent(BEND_M), REFUSED, "cad", drawing=lambda: make_workpiece("s", length_m=0.200)
    ),
    Trouble(
        "wrong: flat, drawn bent", lambda: make_workpiece("s", length_m=0.200), REFUSED, "cad", drawing=_bent(BEND_M)
    ),
    Trouble("wrong: bent over 230 mm, drawn 200", _bent(0.230), REFUSED, "cad", drawing=_bent(BEND_M)),
)


def trouble_trial(trouble: Trouble, seed: int) -> TroubleTrial:
    """One scan, planned; held against what it has to be."""
    scanner = get_scanner(PRESET).resized(WIDEST_PX)
    others = trouble.others(np.random.default_rng([seed, 97]))
    scene = scan_part(trouble.part(), scanner, seed, tilt_rad=math.radians(5.0), spread_m=0.02, others=others)
    began = time.process_time()
    refused, rms, worst, known, within = "", *[math.nan] * 4
    try:
        error, sigma = _plan(scene, trouble)
        rms, worst = 1e3 * float(np.sqrt(np.mean(np.square(error)))), 1e3 * float(np.abs(error).max())
        known, within = 1e3 * float(np.sqrt(np.mean(np.square(sigma)))), float(np.mean(np.abs(error) < 2.0 * sigma))
    except WeldcalError as refusal:
        refused = f"{type(refusal).__name__}: {refusal}"
    ok = trouble.must in ("", REFUSED if refused else PLANNED)
    return TroubleTrial(
        trouble.name, trouble.method, seed, refused, rms, worst, known, within, ok, time.process_time() - began
    )


def _plan(scene: Scene, trouble: Trouble) -> tuple[np.ndarray, np.ndarray]:
    if trouble.method == "cloud":
        return try_cloud(scene)
    return try_cad(scene, None if trouble.drawing is None else trouble.drawing())


def run_troubles(runs: int, first_seed: int) -> list[TroubleTrial]:
    """Every kind of trouble, `runs` times."""
    return [trouble_trial(trouble, first_seed + k) for trouble in TROUBLES for k in range(runs)]


def trouble_rows(trials: list[TroubleTrial]) -> dict[str, str]:
    """A line per kind and method."""
    rows: dict[str, str] = {}
    for name, method in dict.fromkeys((t.name, t.method) for t in trials):
        mine = [t for t in trials if (t.name, t.method) == (name, method)]
        done = [t for t in mine if not t.refused]
        text = f"{len(done)} of {len(mine)} planned, {sum(t.ok for t in mine)} as they have to be"
        if done:
            rms = math.sqrt(float(np.mean([t.rms_mm**2 for t in done])))
            sigma = math.sqrt(float(np.mean([t.sigma_mm**2 for t in done])))
            within = 100.0 * float(np.mean([t.within_2_sigma for t in done]))
            text += (
                f"; error rms {rms:.3f}, worst {max(t.worst_mm for t in done):.2f} mm; sigma stated {sigma:.3f} mm "
                f"({within:.0f} % of the line within 2 sigma)"
            )
        rows[f"{name}, {method}"] = text
    return rows
