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
from weldcal.systems.viewer.scene import RESIDUAL_MM, coloured, draw_mesh, legend, set_the_scene
from weldcal.tools.dashboard.facts import facts_of
from weldcal.tools.dashboard.values import scan_rows, weld_rows
from weldcal.tools.report.pictures import overlay_colours

_PAGE = Path(__file__).parent / "page"
_ROBOT = Rgba(0.62, 0.66, 0.70, 0.25)
_ROW = "<tr><td>{name}<td>{points}<td>{median_mm:.2f}<td>{p95_mm:.2f}<td>{signed_mm:+.2f}"
_SCAN = (
    "<div id=w-top><strong>Scan {scan}: distance, mm</strong><table cellpadding=3><tr><th>part<th>points<th>median"
    "<th>95 %<th>signed median{rows}</table></div><div id=w-keys><div class=scale>distance from the robot's"
    " surface<i></i><span class=ends><span>inside {limit:g} mm</span><span>0</span><span>{limit:g} mm outside</span>"
    "</span></div><div>grey: not on the robot (over {band:g} mm)</div></div>"
)
_POINTS, _POINT_M = 300_000, 0.0012  # a choice: some megabytes, and no gaps at a pixel of 1 mm
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
    for n, body in enumerate(found.bodies):
        for k, mesh in enumerate(body.meshes):
            draw_mesh(meshcat, f"/robot/{n}/{k}", mesh.vertices.T, mesh.triangles.T, _ROBOT)
        meshcat.SetTransform(f"/robot/{n}", body.X_BL)
    drawn = np.random.default_rng(0).permutation(len(found.body))[:_POINTS]
    meshcat.SetObject("/scan", coloured(found.points_B[drawn], overlay_colours(found)[drawn]), _POINT_M)
    on = found.points_B[found.body >= 0]
    middle, size = np.median(on, axis=0), float(np.linalg.norm(np.ptp(on, axis=0)))
    towards = found.X_BC.translation() - middle
    set_the_scene(meshcat, middle + 1.3 * size * towards / np.linalg.norm(towards), middle, RigidTransform())
    for end in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background", end, [0.20, 0.22, 0.25])
    rows = [_ROW.format(name=escape(name), **row) for name, row in found.rows.items()]
    head, end, tail = meshcat.StaticHtml().rpartition("</body>")
    legend = _SCAN.format(scan=escape(found.scan), rows="".join(rows), limit=found.scale_mm, band=1e3 * BAND_M)
    return f"{head}<style>{_style()}</style>{legend}{end}{tail}"


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
