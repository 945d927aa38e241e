"""Pages of the 3D view: recording.html with phase, figures, legend and cameras, and a scan over the robot's shape."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import escape
from pydrake.geometry import Meshcat, MeshcatParams, Rgba
from pydrake.math import RigidTransform

from weldcal.calibration.recorded_overlay import BAND_M, Overlay
from weldcal.systems.cell import Cell
from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import Run
from weldcal.systems.viewer.cameras import CAMERAS, ZOOM
from weldcal.systems.viewer.live import LiveView
from weldcal.systems.viewer.scene import RESIDUAL_MM, coloured, diverging, draw_mesh, legend, set_the_scene
from weldcal.tools.dashboard.facts import facts_of
from weldcal.tools.dashboard.values import scan_rows, weld_rows

_PAGE = Path(__file__).parent / "page"
_ROBOT, _ELSEWHERE, _BACKGROUND = Rgba(0.62, 0.66, 0.70, 0.25), Rgba(0.45, 0.48, 0.52, 1.0), [0.20, 0.22, 0.25]
_COLUMNS = "<th>part<th>points<th>median, unsigned<th>95 %, unsigned<th>median, signed"
_POINTS, _POINT_M = 150_000, 0.0012  # a choice: some megabytes, and no gaps at a pixel of 1 mm
_ROWS = 1500  # of the weld, in the page


def with_overlay(html: str, run: Run[Any], live: LiveView, title: str) -> str:
    """Return the page of Meshcat.StaticHtml() with the overlay of this run; unchanged where it has no end of a body."""
    head, end, tail = html.rpartition("</body>")
    if not end:
        return html
    told = json.dumps(_told(run.cell, run, live, title), allow_nan=False).replace("<", "\\u003c")
    script, page = ((_PAGE / name).read_text() for name in ("overlay.js", "overlay.html"))
    return f"{head}<style>{_style()}</style>{page}<script>const run = {told};\n{script}</script>{end}{tail}"


def _style() -> str:
    return (_PAGE / "overlay.css").read_text()


def scan_page(found: Overlay) -> str:
    """Return a page of Meshcat: the robot's shape in the base, and the scan's points on it by their distance."""
    meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    for body in found.bodies:
        for k, mesh in enumerate(body.meshes):
            draw_mesh(meshcat, f"/robot/{body.name}/{k}", mesh.vertices.T, mesh.triangles.T, _ROBOT)
        meshcat.SetTransform(f"/robot/{body.name}", body.X_BL)
    limit, on = found.scale_mm, found.on_robot
    rng = np.random.default_rng(0)
    others, own = (rng.permutation(np.flatnonzero(mask))[:_POINTS] for mask in (~on, on))
    meshcat.SetObject("/scan/elsewhere", coloured(found.points_B[others]), _POINT_M, _ELSEWHERE)
    colours = diverging(1e3 * found.distance[own] / limit)
    meshcat.SetObject("/scan/on_robot", coloured(found.points_B[own], colours), _POINT_M)
    middle = np.median(found.points_B[on], axis=0)
    size = float(np.linalg.norm(np.ptp(found.points_B[on], axis=0)))
    towards = found.X_BC.translation() - middle
    set_the_scene(meshcat, middle + 1.3 * size * towards / np.linalg.norm(towards), middle, RigidTransform())
    meshcat.SetProperty("/Background", "top_color", _BACKGROUND)
    meshcat.SetProperty("/Background", "bottom_color", _BACKGROUND)
    rows = "".join(
        f"<tr><td>{escape(name)}<td>{r['points']:.0f}<td>{r['median_mm']:.2f}<td>{r['p95_mm']:.2f}<td>{r['signed_mm']:+.2f}"
        for name, r in found.rows.items()
    )
    head, end, tail = meshcat.StaticHtml().rpartition("</body>")
    keys = (
        f"<div class=scale>distance from the robot's surface<i></i><span class=ends><span>inside {limit:g} mm</span>"
        f"<span>0</span><span>{limit:g} mm outside</span></span></div><div>grey: not on the robot (over"
        f" {1e3 * BAND_M:g} mm)</div>"
    )
    top = f"<strong>Scan {escape(found.scan)}: distance, mm</strong><table cellpadding=3><tr>{_COLUMNS}</tr>{rows}</table>"
    return f"{head}<style>{_style()}</style><div id=w-top>{top}</div><div id=w-keys>{keys}</div>{end}{tail}"


def _told(cell: Cell[Any], run: Run[Any], live: LiveView, title: str) -> dict[str, Any]:
    """Return the overlay's text at each time of the recording."""
    facts = facts_of(cell, title, "")
    weld = weld_rows(live.weld[:: max(1, len(live.weld) // _ROWS)])
    words = facts.required_mm == facts.required_mm and bool(facts.seconds)
    places = [[p.time, p.view, p.eye, p.target] for p in live.views.places]
    return {
        "title": title,
        "phases": [[t, phase_words(name)] for name, t, _ in run.phases],
        "legends": [
            [t, [k._asdict() for k in legend(name, 0)] if words or live.weld else []] for name, t, _ in run.phases
        ],
        "weld": weld,
        "scans": [[t, *row] for t, row in zip(live.scan_times, scan_rows(live.scans), strict=True)],
        "required_mm": facts.required_mm if facts.required_mm == facts.required_mm else None,
        "scale_mm": RESIDUAL_MM,
        "places": places,
        "zoom": ZOOM,
        "cameras": [[name, CAMERAS[name]] for name in live.views.known],
    }
