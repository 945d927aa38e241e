"""Plan seams from one scan, by drawing and from the cloud: every scanner in random poses, and hard cases."""

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from tests.figures.harness import Run, figure
from tests.worlds.parts.scans import PLANNED, REFUSED, TROUBLES, WIDEST_PX, Scene, Trouble, scan, scan_part, sideways
from weldcal.models.errors import WeldcalError
from weldcal.models.scanners import SCANNERS, get_scanner
from weldcal.models.workpieces.plate import Workpiece
from weldcal.tools.console import Progress
from weldcal.welding.locate.find_workpiece import find_workpiece
from weldcal.welding.locate.groove.extract import extract_groove
from weldcal.welding.locate.planes import Floats

SHAPES = ("straight", "s", "l", "corner", "bent")  # l: corner radius 20 mm; corner: 4 mm; bent: s over 200 mm
FIRST_HELD_OUT = 1000  # seeds from here on were not used while the figures of the algorithms were set
JUDGED = ("rms_mm", "worst_mm", "sigma_mm", "chi", "within_2_sigma")
Plan = dict[str, Any]
"""The plan of one scan by one method: lengths in mm, NaN where it was refused; processor seconds."""


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


def figures(plan: Callable[[], tuple[Floats, Floats]]) -> Plan:
    """Run `plan`, which returns errors and sigmas (N,) m, and judge it; a named refusal is a result."""
    began = time.process_time()
    try:
        error, sigma = plan()
    except WeldcalError as refusal:
        sentence, nothing = f"{type(refusal).__name__}: {refusal}", dict.fromkeys(JUDGED, math.nan)
        return {"refused": sentence, **nothing, "seconds": time.process_time() - began}
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


def plan_rows(plans: list[Plan], key: str) -> dict[str, str]:
    """Make a line per preset or trouble (``key``) and method: planned of all, errors sideways, sigma stated.

    Errors are rms and worst; of the presets CPU seconds, of the troubles how many are as they have to be.
    """
    rows: dict[str, str] = {}
    for name, method in dict.fromkeys((t[key], t["method"]) for t in plans):
        mine = [t for t in plans if (t[key], t["method"]) == (name, method)]
        done = [t for t in mine if not t["refused"]]
        planned = f"{len(done)} of {len(mine)} planned"
        if key == "name":
            rows[f"{name}, {method}"] = f"{planned}, {sum(t['ok'] for t in mine)} as they have to be{error_text(done)}"
        else:
            seconds = f"; {np.mean([t['seconds'] for t in done]):.2f} s CPU" if done else f"; {mine[0]['refused']}"
            rows[f"{name} {method}"] = f"{planned}{error_text(done)}{seconds}"
    return rows


def error_text(planned: Sequence[Plan]) -> str:
    """Errors and stated sigmas of the plans, as a part of a sentence; empty for none."""
    if not planned:
        return ""
    within = 100.0 * float(np.mean([t["within_2_sigma"] for t in planned]))
    return (
        f"; error rms {_rms([t['rms_mm'] for t in planned]):.3f}, worst {max(t['worst_mm'] for t in planned):.2f} mm;"
        f" sigma stated {_rms([t['sigma_mm'] for t in planned]):.3f} mm ({within:.0f} % of the line within 2 sigma)"
    )


PRESET = "phoxi_m"


def trouble_trial(trouble: Trouble, seed: int) -> Plan:
    """One scan, planned; held against what it has to be."""
    scanner = get_scanner(PRESET).resized(WIDEST_PX)
    others = trouble.others(np.random.default_rng([seed, 97]))
    scene = scan_part(trouble.part(), scanner, seed, tilt_rad=math.radians(5.0), spread_m=0.02, others=others)
    drawing = None if trouble.drawing is None else trouble.drawing()
    plan = figures(lambda: try_cloud(scene) if trouble.method == "cloud" else try_cad(scene, drawing))
    ok = trouble.must in ("", REFUSED if plan["refused"] else PLANNED)
    return {"name": trouble.name, "method": trouble.method, "seed": seed, "ok": ok, **plan}


def plans_of(
    presets: Sequence[str], runs: int, seed: int, progress: Progress, shapes: Sequence[str] = SHAPES
) -> list[Plan]:
    """Plan every preset, shape and method over ``runs`` held-out poses."""
    plans: list[Plan] = []
    for k, preset in enumerate(presets):
        for shape in shapes:
            progress(f"{preset}, {shape}", k / len(presets))
            for number in range(FIRST_HELD_OUT + seed, FIRST_HELD_OUT + seed + runs):
                scene = scan(preset, shape, number, WIDEST_PX)
                named = {"preset": preset, "shape": shape, "seed": number}
                plans += [{**named, "method": m, **figures(partial(plan, scene))} for m, plan in METHODS.items()]
    return plans


@figure("seam-planning", "the error of a seam planned from one scan, with and without a drawing, for each scanner")
def planning(run: Run) -> None:
    """Plan seams in random poses, and in hard cases: occlusion, clutter and wrong workpieces."""
    runs = run.size(1, 5)
    rows = plan_rows(plans_of(run.size((PRESET,), tuple(SCANNERS)), runs, run.seed, run.progress), "preset")
    if run.full:
        seeds = range(FIRST_HELD_OUT + run.seed, FIRST_HELD_OUT + run.seed + runs)
        rows |= plan_rows([trouble_trial(trouble, seed) for trouble in TROUBLES for seed in seeds], "name")
    run.table("", ("scans", "found"), rows.items())
