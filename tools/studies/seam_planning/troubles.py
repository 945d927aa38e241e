"""Hard cases of seam planning: occlusion, clutter, and parts that are not the one in the drawing."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.bent_workpiece import bend
from weldcal.models.mesh import TriMesh
from weldcal.models.scanners import get_scanner
from weldcal.models.workpieces import Workpiece, make_workpiece
from weldcal.tools.studies.seam_planning.scenes import Scene, box, scan_part
from weldcal.tools.studies.seam_planning.trials import BEND_M, WIDEST_PX, Plan, error_text, figures, try_cad, try_cloud

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


COLUMNS = (
    "name", "method", "seed", "refused", "rms_mm", "worst_mm", "sigma_mm", "within_2_sigma", "ok", "seconds",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TroubleTrial(Plan):
    """One scan in one kind of trouble; must: as in Trouble."""

    name: str
    must: str

    @property
    def ok(self) -> bool:
        """Whether the answer is what it has to be."""
        return self.must in ("", REFUSED if self.refused else PLANNED)


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


def _flat() -> Workpiece:
    return make_workpiece("s", length_m=0.200)


def _bent(radius_m: float) -> Callable[[], Workpiece]:
    return lambda: bend(_flat(), radius_m)


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
    *(
        Trouble(f"wrong: {name}", part, REFUSED, "cad", drawing=drawing)
        for name, part, drawing in (
            ("6 mm wider", lambda: make_workpiece("s", length_m=0.250, width_m=0.206), _s),
            ("5 mm longer", lambda: make_workpiece("s", length_m=0.255), _s),
            ("another groove", lambda: make_workpiece("straight", length_m=_s().size_m[0]), _s),
            ("bent, drawn flat", _bent(BEND_M), _flat),
            ("flat, drawn bent", _flat, _bent(BEND_M)),
            ("bent over 230 mm, drawn 200", _bent(0.230), _bent(BEND_M)),
        )
    ),
)


def trouble_trial(trouble: Trouble, seed: int) -> TroubleTrial:
    """One scan, planned; held against what it has to be."""
    scanner = get_scanner(PRESET).resized(WIDEST_PX)
    others = trouble.others(np.random.default_rng([seed, 97]))
    scene = scan_part(trouble.part(), scanner, seed, tilt_rad=math.radians(5.0), spread_m=0.02, others=others)
    plan = figures(lambda: _plan(scene, trouble))
    return TroubleTrial(name=trouble.name, must=trouble.must, method=trouble.method, seed=seed, **plan)


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
        right = f"{sum(t.ok for t in mine)} as they have to be"
        rows[f"{name}, {method}"] = f"{len(done)} of {len(mine)} planned, {right}{error_text(done)}"
    return rows
