"""Plans seams from one scan, by drawing and from the cloud alone: every scanner preset in random poses, and hard cases."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh
from weldcal.models.scanners import SCANNERS, get_scanner
from weldcal.models.workpieces.part import bend
from weldcal.models.workpieces.plate import Workpiece, make_workpiece
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.report.files import records_csv
from weldcal.tools.report.render import write_atomic
from weldcal.tools.worlds.parts.plates import Scene, box, scan_part, sideways
from weldcal.welding.locate.find_workpiece import find_workpiece
from weldcal.welding.locate.groove.extract import extract_groove
from weldcal.welding.locate.planes import Floats

WIDEST_PX = 824
SHAPES = ("straight", "s", "l", "corner", "bent")  # l: corner radius 20 mm; corner: 4 mm; bent: s over 200 mm
CORNER_M, BEND_M = 0.004, 0.200
FIRST_HELD_OUT = 1000  # seeds from here on were not used while the figures of the algorithms were set


COLUMNS = (
    "preset", "method", "shape", "seed", "refused", "rms_mm", "worst_mm", "sigma_mm", "chi", "within_2_sigma", "seconds",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The plan of one scan by one method; lengths in mm, NaN where it was refused; processor seconds."""

    method: str
    seed: int
    refused: str
    rms_mm: float = math.nan
    worst_mm: float = math.nan
    sigma_mm: float = math.nan
    chi: float = math.nan
    within_2_sigma: float = math.nan
    seconds: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Trial(Plan):
    """One scan of a part under a scanner preset."""

    preset: str
    shape: str


def part_for(preset: str, shape: str) -> Workpiece:
    """A workpiece that the preset's field of view holds in any turn."""
    scanner = get_scanner(preset)
    small = min(scanner.footprint_m(min(0.93, 0.97 * scanner.far_m))) < 0.35
    kind = {"corner": "l", "bent": "s"}.get(shape, shape)
    radius = CORNER_M if shape == "corner" else None
    if small:
        part = make_workpiece(kind, length_m=0.200, width_m=0.130 if kind != "l" else 0.150, radius_m=radius)
    else:
        part = make_workpiece(kind, length_m=0.200 if shape == "bent" else 0.300, radius_m=radius)
    return bend(part, BEND_M) if shape == "bent" else part


def scan(preset: str, shape: str, seed: int, widest_px: int | None = WIDEST_PX) -> Scene:
    """A part under that preset, at most `widest_px` wide (None: as the scanner has it), in a random pose tilted by up to 5 deg."""
    scanner = get_scanner(preset)
    scanner = scanner.resized(widest_px) if widest_px is not None and scanner.width > widest_px else scanner
    part = part_for(preset, shape)
    return scan_part(part, scanner, seed, tilt_rad=math.radians(5.0), spread_m=0.0 if part.size_m[1] < 0.16 else 0.05)


def try_cloud(scene: Scene) -> tuple[Floats, Floats]:
    """Errors and sigmas (N,) m of the root found in the cloud alone."""
    groove = extract_groove(scene.cloud_B)
    return sideways(groove.root, scene.part, scene.X_BP)[0], groove.sigma


def try_cad(scene: Scene, drawing: Workpiece | None = None) -> tuple[Floats, Floats]:
    """Errors and sigmas (N,) m of the drawn root, the plate found anywhere; the hint is 70 deg off.

    drawing: what is looked for, where it is not the part that lies there.
    """
    x = scene.X_BP.rotation().matrix()[:, 0]
    found = find_workpiece(
        scene.cloud_B,
        drawing or scene.part,
        turn_hint_rad=math.atan2(x[1], x[0]) + math.radians(70.0),
        eye_B=scene.eye_B,
    )
    root = scene.part.seam_P[::4] @ found.X_BP.rotation().matrix().T + found.X_BP.translation()
    error, _ = sideways(root, scene.part, scene.X_BP)
    return error, np.full(len(error), found.registration.seam_sigma_m)


METHODS = {"cad": try_cad, "cloud": try_cloud}


def run_trial(scene: Scene, preset: str, shape: str, seed: int, method: str) -> Trial:
    """Plan one scan by one method; a named refusal is a result."""
    return Trial(preset=preset, shape=shape, method=method, seed=seed, **figures(lambda: METHODS[method](scene)))


def figures(plan: Callable[[], tuple[Floats, Floats]]) -> dict[str, Any]:
    """Run `plan`, which returns errors and sigmas (N,) m; the fields of a Plan that follow from it."""
    began = time.process_time()
    try:
        error, sigma = plan()
    except WeldcalError as refusal:
        return {"refused": f"{type(refusal).__name__}: {refusal}", "seconds": time.process_time() - began}
    return {
        "refused": "",
        "rms_mm": 1e3 * _rms(error),
        "worst_mm": 1e3 * float(np.abs(error).max()),
        "sigma_mm": 1e3 * _rms(sigma),
        "chi": _rms(error / sigma),
        "within_2_sigma": float(np.mean(np.abs(error) < 2.0 * sigma)),
        "seconds": time.process_time() - began,
    }


def _rms(values: Any) -> float:
    return math.sqrt(float(np.mean(np.square(values))))


def summary_rows(trials: list[Trial]) -> dict[str, str]:
    """A line per preset and method: planned of all, errors sideways (rms and worst), sigma stated, CPU seconds."""
    rows: dict[str, str] = {}
    for preset in dict.fromkeys(t.preset for t in trials):
        for method in METHODS:
            mine = [t for t in trials if t.preset == preset and t.method == method]
            done = [t for t in mine if not t.refused]
            seconds = f"; {np.mean([t.seconds for t in done]):.2f} s CPU" if done else f"; {mine[0].refused}"
            rows[f"{preset} {method}"] = f"{len(done)} of {len(mine)} planned{error_text(done)}{seconds}"
    return rows


def error_text(planned: Sequence[Plan]) -> str:
    """Errors and stated sigmas of the plans, as a part of a sentence; empty for none."""
    if not planned:
        return ""
    within = 100.0 * float(np.mean([t.within_2_sigma for t in planned]))
    return (
        f"; error rms {_rms([t.rms_mm for t in planned]):.3f}, worst {max(t.worst_mm for t in planned):.2f} mm; sigma stated "
        f"{_rms([t.sigma_mm for t in planned]):.3f} mm ({within:.0f} % of the line within 2 sigma)"
    )


PRESET = "phoxi_m"
PLANNED, REFUSED = "planned", "refused"


@dataclass(frozen=True)
class Trouble:
    """A kind of scene. others: objects beside the part; drawing: what is looked for, None: the part itself; must: what the
    answer has to be, empty where a plan with an honest sigma and a refusal are both right.
    """

    name: str
    part: Callable[[], Workpiece]
    must: str
    method: str
    others: Callable[[np.random.Generator], list[TriMesh]] = lambda rng: []
    drawing: Callable[[], Workpiece] | None = None


TROUBLE_COLUMNS = (
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
    """Boxes around the part, some as high as it, and one on its edge."""
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


def run_seam_planning_benchmark(
    out: Path,
    runs: int = 2,
    seed: int = 0,
    presets: list[str] | None = None,
    progress: Progress = no_progress,
    *,
    full: bool = False,
    troubles: bool = True,
) -> tuple[dict[str, object], dict[str, str]]:
    """Every preset, shape and method over `runs` held-out poses: trials.csv in `out`, and the rows of the table.

    full: images as wide as the scanner has them. troubles: occlusion, clutter and wrong workpieces as well (troubles.csv).
    """
    presets = list(SCANNERS) if presets is None else presets
    trials: list[Trial] = []
    total = len(presets) * len(SHAPES) * runs
    for preset in presets:
        for shape in SHAPES:
            for k in range(runs):
                number = FIRST_HELD_OUT + seed + k
                scene = scan(preset, shape, number, None if full else WIDEST_PX)
                trials += [run_trial(scene, preset, shape, number, method) for method in METHODS]
                progress("planning", len(trials) / (len(METHODS) * total))
                write_atomic(out / "trials.csv", records_csv(trials, COLUMNS))
    rows = summary_rows(trials)
    if troubles:
        cases = run_troubles(runs, FIRST_HELD_OUT + seed)
        write_atomic(out / "troubles.csv", records_csv(cases, TROUBLE_COLUMNS))
        rows |= trouble_rows(cases)
    done = [t for t in trials if not t.refused]
    summary: dict[str, object] = {
        "state": "done",
        "trials": len(trials),
        "planned": len(done),
        "worst_mm": max((t.worst_mm for t in done), default=math.nan),
        "most_seconds": max((t.seconds for t in trials), default=math.nan),
    }
    return summary, rows


@command("benchmark seam-planning", short_help="Measure the error of a seam planned from one scan.", hidden=True)
def planning(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Random poses of each part.", min=1)] = 2,
    preset: Annotated[
        list[str] | None, option("--preset", "NAME", "A scanner; repeat for more.", show_default="all")
    ] = None,
    full: Annotated[
        bool, switch("--full-resolution", "Images of the scanner's full width, not 824 pixels at most.")
    ] = False,
    troubles: Annotated[
        bool, switch("--troubles/--no-troubles", "Also test occlusion, clutter and wrong workpieces.")
    ] = True,
) -> Outcome:
    """Measure the error of a seam planned from one scan, with and without a drawing, for each scanner."""
    folder = call.folder("benchmark", "seam-planning")
    names = [get_scanner(name).name for name in preset] if preset else None
    summary, rows = run_seam_planning_benchmark(
        folder, runs, call.seed, names, call.progress, full=full, troubles=troubles
    )
    return Outcome(summary, rows=rows)
