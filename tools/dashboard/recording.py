"""Write recording.html: the 3D page with phase, figures, legend, and cameras that follow until one is moved."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from weldcal.systems.cell import Cell
from weldcal.systems.phase_words import phase_words
from weldcal.systems.runner import Run
from weldcal.systems.viewer.cameras import CAMERAS, ZOOM
from weldcal.systems.viewer.live import LiveView
from weldcal.systems.viewer.scene import RESIDUAL_MM, legend
from weldcal.tools.dashboard.facts import facts_of
from weldcal.tools.dashboard.values import scan_rows, weld_rows

PAGE = Path(__file__).parent / "page"
_ROWS = 1500  # of the weld, in the page


def with_overlay(html: str, run: Run[Any], live: LiveView, title: str) -> str:
    """Return the page of Meshcat.StaticHtml() with the overlay of this run; unchanged where it has no end of a body."""
    head, end, tail = html.rpartition("</body>")
    if not end:
        return html
    told = json.dumps(_told(run.cell, run, live, title), allow_nan=False).replace("<", "\\u003c")
    style, script = (PAGE / "overlay.css").read_text(), (PAGE / "overlay.js").read_text()
    page = (PAGE / "overlay.html").read_text()
    return f"{head}<style>{style}</style>{page}<script>const run = {told};\n{script}</script>{end}{tail}"


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
