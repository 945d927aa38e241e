"""A scan over the robot's shape, coloured by its distance: the picture and the page of `weldcal view`."""

import numpy as np
from markupsafe import escape
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatParams, Rgba
from pydrake.math import RigidTransform

from weldcal.calibration.recorded_overlay import BAND_M, Overlay
from weldcal.systems.viewer.scene import coloured, diverging, draw_mesh, set_the_scene
from weldcal.tools.dashboard.recording import PAGE
from weldcal.tools.report.pictures import png, subplots

_ROBOT = Rgba(0.62, 0.66, 0.70, 0.25)
_ROW = "<tr><td>{name}<td>{points}<td>{median_mm:.2f}<td>{p95_mm:.2f}<td>{signed_mm:+.2f}"
_SCAN = (
    "<div id=w-top><strong>Scan {scan}: distance, mm</strong><table cellpadding=3><tr><th>part<th>points<th>median"
    "<th>95 %<th>signed median{rows}</table></div><div id=w-keys><div class=scale>distance from the robot's"
    " surface<i></i><span class=ends><span>inside {limit:g} mm</span><span>0</span><span>{limit:g} mm outside</span>"
    "</span></div><div>grey: not on the robot (over {band:g} mm)</div></div>"
)
_POINTS, _POINT_M = 300_000, 0.0012  # a choice: some megabytes, and no gaps at a pixel of 1 mm
_INK = 5e4  # points of print squared that the dots of an overlay cover: about its half, a choice
_DRAWN = 200_000  # of an overlay: a choice, more hide each other at this size


def overlay_colours(found: Overlay) -> NDArray[np.uint8]:
    """Colours (N, 3) RGB of a scan's points: by distance from the robot (blue: inside), others grey."""
    share = 1e3 * np.nan_to_num(found.distance) / found.scale_mm
    return np.where(found.body[:, None] < 0, np.uint8(70), diverging(share))


def overlay_picture(found: Overlay) -> bytes:
    """Draw a scan as the scanner sees it, its points on the robot by distance from the surface; PNG."""
    limit, on, size = found.scale_mm, found.body >= 0, found.rows["robot"]
    seen = 1e3 * found.X_BC.inverse().multiply(found.points_B.T)[:2]
    figure, axes = subplots(6.8, 5.6)
    axes.set_facecolor("#22262b")  # the pale middle of the colours shows on it
    drawn = np.random.default_rng(0).permutation(len(on))[:_DRAWN]
    dot = min(9.0, _INK / np.count_nonzero(on[drawn]))
    axes.scatter(*seen[:, drawn], c=overlay_colours(found)[drawn] / 255.0, s=dot, linewidths=0)
    (left, top), (right, bottom) = np.percentile(seen[:, on], [0.1, 99.9], axis=1)
    margin = 0.08 * max(right - left, bottom - top)
    axes.set(xlim=(left - margin, right + margin), ylim=(bottom + margin, top - margin), aspect="equal")
    lengths = "{points} points on it, median {median_mm:.2f}, 95 % {p95_mm:.2f}, signed median {signed_mm:+.2f} mm"
    axes.set_title(f"scan {found.scan}, distance from the robot:\n{lengths.format(**size)}", fontsize=10, loc="left")
    axes.set(xlabel="camera x, mm", ylabel="camera y, mm")
    colours = ListedColormap(diverging(np.linspace(-1.0, 1.0, 255)) / 255.0)
    bar = ScalarMappable(Normalize(-limit, limit), colours)
    figure.colorbar(bar, ax=axes, extend="both", label="mm from the surface (below 0: inside; grey: not on the robot)")
    return png(figure)


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
    return f"{head}<style>{(PAGE / 'overlay.css').read_text()}</style>{legend}{end}{tail}"
