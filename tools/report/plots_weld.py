"""Plots of a weld: the paths over the seam (the paper's Fig. 13) and the quantities along it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context
from scipy.spatial import cKDTree

from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh
from weldcal.systems.cell import Cell
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.messages import SeamRecord
from weldcal.tools.report.pictures import GREY, OURS, PLANNED, ROBOT, TORCH, TRUTH, plain, subplots, svg
from weldcal.tools.report.weld import WeldOutcome, true_seam, welds
from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.planes import into
from weldcal.welding.record.order import OrderLimits
from weldcal.welding.record.process import PathError, speed_along
from weldcal.welding.record.weld_log import WeldRecord
from weldcal.welding.record.welded_seam import burns, place_mm, travel_speed
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase

_SMALL = 8
_INCH = 1.35  # height of one curve
_SMOOTH_S = 0.2  # a choice: a reader's eye takes the mean of a pulsed or noisy arc
APART_M = 2e-3  # a choice: places of one arc are far nearer to each other
_ALONG = 0.99  # a chord that lies along the seam has no place worth a mark
_AGREES_M, _BESIDE_M, _MOST_DOTS = 0.001, 0.015, 6000  # registration.TOLERANCE_M; what is drawn beside the part
_DOTTED = (0, (1.2, 0.7))


@dataclass(frozen=True, kw_only=True, eq=False)
class WeldTrace:
    """A weld as it is plotted, SI units; N rows from the first contact on.

    Attributes:
        s: (N,) the torch along the seam, m, negative before it; torch_on, felt: (N,) arc burning, tip in contact.
        tip, torch, robot: (N,3) paths; planned, true: (M,3) lines, as far as they are known.
        plan_error, torch_error: (arc length, lateral, height) from the true seam, m; None where there is no truth.
        delta_n, delta_axial, speed, omega, n_d_dot_n_t: (N,); speed is the torch's, m/s.
        e_t: (N,) the servo's estimate of the torch's distance from the refined seam, m; drawn where there is no truth.
        weld_speed, delta_d, axial_d, omega_max: the set values.
        work, travel: (N,) rad; predicted: (N,) travel angle predicted from the seam; windows: their (work, travel)
            limits.
        axes: which coordinates are drawn to the right and up, and their names.
    """

    s: Array
    torch_on: NDArray[np.bool_]
    felt: NDArray[np.bool_]
    tip: Array
    torch: Array
    robot: Array
    planned: Array | None
    true: Array | None
    plan_error: tuple[Array, Array, Array] | None
    torch_error: tuple[Array, Array, Array] | None
    delta_n: Array
    delta_axial: Array
    speed: Array
    omega: Array
    n_d_dot_n_t: Array
    weld_speed: float
    delta_d: float
    axial_d: float
    omega_max: float
    e_t: Array | None = None
    work: Array | None = None
    travel: Array | None = None
    predicted: Array | None = None
    windows: tuple[float, float] = (np.inf, np.inf)
    axes: tuple[int, int] = (0, 1)
    names: tuple[str, str] = field(default=("x, mm", "y, mm"))


def part_in_scan(points_B: Array, mesh: TriMesh, X_BP: RigidTransform) -> bytes:
    """Draw where the scan (N,3) m agrees with the drawn part, from above and from two sides."""
    model = PartModel(mesh)
    scan = into(X_BP, points_B[np.isfinite(points_B).all(axis=1)])
    low, high = mesh.bounds
    scan = scan[((scan > low - _BESIDE_M) & (scan < high + _BESIDE_M)).all(axis=1)]
    scan = scan[:: 1 + len(scan) // _MOST_DOTS]
    away = np.linalg.norm(scan - model.closest(scan)[0], axis=1) if len(scan) else np.zeros(0)
    surface = model.points[:: max(1, len(model.points) // _MOST_DOTS)]
    spacing = 0.0 if len(scan) < 2 else float(np.median(np.asarray(cKDTree(scan).query(scan, k=2)[0])[:, 1]))
    shown = np.isfinite(np.asarray(cKDTree(scan).query(surface, distance_upper_bound=_AGREES_M + 3.0 * spacing)[0]))
    R = X_BP.rotation().matrix()
    drawn, found = (1e3 * (p @ R.T + X_BP.translation()) for p in (surface, scan))
    picture = Figure(figsize=(8.2, 3.4), layout="constrained")
    groups = (
        ("drawn, not in the scan", GREY, drawn[~shown]),
        ("the scan shows the drawn surface", ROBOT, found[away < _AGREES_M]),
        ("the scan shows another thing", TRUTH, found[away >= _AGREES_M]),
    )
    panes = picture.subplots(1, 3)
    for axes, (i, j) in zip(panes, ((0, 1), (0, 2), (1, 2)), strict=True):
        for name, colour, p in groups:
            axes.plot(p[:, i], p[:, j], ".", ms=1.2, color=colour, label=name, rasterized=True)
        axes.set_aspect("equal")
        plain(axes, f"{'xyz'[i]}, mm", f"{'xyz'[j]}, mm")
    picture.legend(
        *panes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, markerscale=8, fontsize=_SMALL
    )
    return svg(picture, *panes)


NEXT_SEAM_S = 0.5  # a choice: rows of one seam are 8 ms apart, and between two seams the arm goes home


def broken(values: Array, at: NDArray[np.intp]) -> Array:
    """Return a copy (N, ...) with NaN in the rows ``at``: a line that is drawn through it has a gap there."""
    found = np.array(values, dtype=float)
    found[at] = np.nan
    return found


def paths(trace: WeldTrace) -> bytes:
    """Planned and true seam, tip, torch and robot from above, a detail of the sharpest turn, and the lateral errors."""
    i, j = trace.axes
    drawn = [line for line in (trace.robot, trace.torch, trace.planned, trace.true) if line is not None]
    drawn = [line[np.isfinite(line).all(axis=1)] for line in drawn]
    reach = np.ptp(np.vstack(drawn), axis=0)
    wide = reach[i] > 1.8 * reach[j]
    if wide:
        height = float(np.clip(6.6 * reach[j] / max(reach[i], 1e-6) + 0.75, 1.15, 3.6))
        picture = Figure(figsize=(7.4, height + 3.2), layout="constrained")
        panes = picture.subplot_mosaic([["above", "above"], ["zoom", "error"]], height_ratios=[height, 2.5])
    else:
        picture = Figure(figsize=(7.4, 5.6), layout="constrained")
        panes = picture.subplot_mosaic([["above", "zoom"], ["above", "error"]], width_ratios=[1.15, 1.0])
    above, zoom, error = panes["above"], panes["zoom"], panes["error"]
    for axes in (above, zoom):
        _lines(axes, trace)
        axes.set_aspect("equal")
        plain(axes, *trace.names)
    low, size = _detail(trace)
    zoom.set_xlim(1e3 * low[0], 1e3 * (low[0] + size))
    zoom.set_ylim(1e3 * low[1], 1e3 * (low[1] + size))
    zoom.set_title("detail", fontsize=_SMALL + 1)
    above.add_patch(
        Rectangle((1e3 * low[0], 1e3 * low[1]), 1e3 * size, 1e3 * size, fill=False, edgecolor="black", linewidth=0.8)
    )
    above.margins(0.06)
    _lateral(error, trace)
    picture.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False, fontsize=9)
    return svg(picture)


def _lines(axes: Axes, trace: WeldTrace) -> None:
    """The paths, each with its own width and dash as well as its own colour."""
    i, j = trace.axes
    felt, on = trace.felt, trace.torch_on
    drawn: Iterable[tuple[Array | None, dict[str, object]]] = (
        (trace.planned, {"color": PLANNED, "lw": 3.5, "ls": _DOTTED, "label": "planned seam"}),
        (
            np.where(felt[:, None], trace.tip, np.nan),
            {"color": OURS, "lw": 4.5, "alpha": 0.45, "label": "tip, as felt"},
        ),
        (np.where(on[:, None], trace.torch, np.nan), {"color": TORCH, "lw": 2.0, "label": "torch, arc on"}),
        (trace.robot, {"color": ROBOT, "lw": 1.2, "ls": "-.", "label": "robot (the tip's rest point)"}),
        (trace.true, {"color": "black", "lw": 0.9, "ls": (0, (4, 3)), "label": "true seam (simulation only)"}),
    )
    for line, style in drawn:
        if line is not None and len(line):
            axes.plot(1e3 * line[:, i], 1e3 * line[:, j], **style)  # type: ignore[arg-type]


def _detail(trace: WeldTrace) -> tuple[Array, float]:
    """Lower left corner (2,) m and side (m) of the detail: where the seam turns most at the torch."""
    i, j = trace.axes
    burning = np.flatnonzero(trace.torch_on & np.isfinite(trace.n_d_dot_n_t))
    at = burning[np.argmin(trace.n_d_dot_n_t[burning])] if len(burning) else len(trace.torch) // 2
    centre = trace.torch[at][[i, j]]
    size = 0.016
    return centre - 0.5 * size, size


def _lateral(axes: Axes, trace: WeldTrace) -> None:
    if trace.plan_error is not None:
        s, lateral, _ = trace.plan_error
        axes.plot(1e3 * s, 1e3 * lateral, color=PLANNED, lw=3.0, ls=_DOTTED, label="plan")
    if trace.torch_error is not None:
        s, lateral, height = trace.torch_error
        axes.plot(1e3 * s, 1e3 * lateral, color=TORCH, lw=1.6, label="torch")
        axes.plot(1e3 * s, 1e3 * height, color=OURS, lw=1.0, ls=":", label="torch, height")
    axes.axhline(0.0, color="black", lw=0.6)
    plain(axes, "true seam, mm", "distance from\nthe true seam, mm")
    axes.margins(y=0.25)
    if trace.plan_error is None and trace.torch_error is None:
        if trace.e_t is not None:
            axes.plot(1e3 * trace.s, 1e3 * np.where(trace.torch_on, trace.e_t, np.nan), color=TORCH, lw=1.6)
        plain(axes, "planned seam, mm", "torch from the seam\nas felt, mm")
        return
    axes.legend(frameon=False, fontsize=_SMALL, ncols=3, loc="upper center", columnspacing=1.0, handlelength=1.5)


def along_the_weld(trace: WeldTrace) -> bytes:
    """Tip deformation, torch speed, turning rate and n_d . n_t over the position of the torch, each with its limits."""
    angles = trace.work is not None and trace.travel is not None
    rows = 5 if angles else 4
    picture = Figure(figsize=(7.4, 1.95 * rows), layout="constrained")
    panes = picture.subplots(rows, 1, sharex=True)
    _deformation(panes[0], trace)
    _speed(panes[1], trace)
    _turning(panes[2], trace)
    _measure(panes[3], trace)
    if angles:
        _angles(panes[4], trace)
    for axes in panes:
        _not_steering(axes, trace)
    panes[-1].set_xlabel("torch along the seam, mm (negative: before it, arc off)")
    picture.align_ylabels(panes)
    return svg(picture)


def _note(axes: Axes, text: str, height: float, hangs: str) -> None:
    """A label at the left edge, where the arc is still off, for a line or band at that height."""
    place = {"xycoords": ("axes fraction", "data"), "fontsize": _SMALL, "in_layout": False}
    axes.annotate(text, (0.004, height), va=hangs, **place)  # type: ignore[arg-type]


def _deformation(axes: Axes, trace: WeldTrace) -> None:
    s = 1e3 * trace.s
    for value, wanted, colour, style, name in (
        (trace.delta_axial, trace.axial_d, ROBOT, "--", "axial"),
        (trace.delta_n, trace.delta_d, OURS, "-", "lateral"),
    ):
        axes.axhspan(0.9e3 * wanted, 1.1e3 * wanted, color=colour, alpha=0.16, lw=0)
        axes.plot(s, 1e3 * value, color=colour, lw=1.2, ls=style, label=f"{name}, set {1e3 * wanted:g} mm ±10 %")
    top = 1.5e3 * max(trace.axial_d, trace.delta_d, 0.8 * float(np.nanmax(trace.delta_axial, initial=0.0)))
    axes.set_ylim(min(0.0, 1.1e3 * float(np.nanmin(trace.delta_n, initial=0.0))), top)
    axes.legend(frameon=False, fontsize=_SMALL, ncols=2, loc="upper right")
    plain(axes, "", "deformation of\nthe tip, mm")


def _speed(axes: Axes, trace: WeldTrace) -> None:
    wanted = 1e3 * trace.weld_speed
    axes.axhspan(0.75 * wanted, 1.25 * wanted, color=TORCH, alpha=0.12, lw=0)
    axes.axhspan(0.99 * wanted, 1.01 * wanted, color=TORCH, alpha=0.45, lw=0)
    v = np.where(trace.torch_on, 1e3 * trace.speed, np.nan)
    axes.plot(1e3 * trace.s, v, color="black", lw=1.0)
    low, high = (float(f(v)) if np.isfinite(v).any() else wanted for f in (np.nanmin, np.nanmax))
    axes.set_ylim(min(0.65 * wanted, low - 0.05 * wanted), max(1.35 * wanted, high + 0.05 * wanted))
    _note(axes, "±25 %", 1.25 * wanted, "top")
    _note(axes, "±1 %", 1.01 * wanted, "bottom")
    plain(axes, "", "travel speed,\nmm/s")


def _turning(axes: Axes, trace: WeldTrace) -> None:
    axes.plot(1e3 * trace.s, trace.omega, color=OURS, lw=1.2)
    for sign in (-1.0, 1.0):
        axes.axhline(sign * trace.omega_max, color="black", lw=0.9, ls="--")
    _note(axes, f"limit {trace.omega_max:g} rad/s", 0.97 * trace.omega_max, "top")
    axes.set_ylim(-1.15 * trace.omega_max, 1.15 * trace.omega_max)
    plain(axes, "", "turning rate,\nrad/s")


def _measure(axes: Axes, trace: WeldTrace) -> None:
    s, n = 1e3 * trace.s, trace.n_d_dot_n_t
    axes.plot(s, n, color=TRUTH, lw=1.2)
    axes.axhline(0.0, color="black", lw=0.9, ls="--")
    good = np.isfinite(n)
    low = min(0.0, float(np.nanmin(n))) if good.any() else 0.0
    axes.set_ylim(low - 0.12, 1.16)
    _note(axes, "0: the published law divides by zero", 0.02, "bottom")
    through = zero_crossings(s, n)
    through = through[np.isfinite(through)]
    axes.plot(through, np.zeros(len(through)), "x", color="black", ms=7, mew=1.6)
    for k, at in enumerate(through[:3]):
        text = {
            "xytext": (0, 9 + 10 * (k % 2)),
            "textcoords": "offset points",
            "fontsize": _SMALL,
            "in_layout": False,
            "ha": "center",
        }
        axes.annotate(f"{at:.0f} mm", (at, 0.0), **text)  # type: ignore[arg-type]
    if good.any() and not len(through) and float(np.nanmin(n)) < _ALONG:
        at = int(np.nanargmin(n))
        axes.plot(s[at], n[at], "o", color="black", ms=4)
        text = {"xytext": (6, -4), "textcoords": "offset points", "fontsize": _SMALL, "in_layout": False, "va": "top"}
        axes.annotate(f"minimum {n[at]:.2f} at {s[at]:.0f} mm", (s[at], n[at]), **text)  # type: ignore[arg-type]
    plain(axes, "", "n$_d$ · n$_t$")


def zero_crossings(s: Array, value: Array) -> Array:
    """Where a value that is sampled at s passes through zero, linearly between samples; NaN breaks the line."""
    a, b = value[:-1], value[1:]
    with np.errstate(invalid="ignore"):
        k = np.flatnonzero((a * b < 0.0) | ((b == 0.0) & (a != 0.0)))
    k = k[np.isfinite(a[k]) & np.isfinite(b[k])]
    return np.asarray(s[k] + (s[k + 1] - s[k]) * a[k] / (a[k] - b[k]))


def _angles(axes: Axes, trace: WeldTrace) -> None:
    assert trace.work is not None
    assert trace.travel is not None
    s = 1e3 * trace.s
    values = [trace.work, trace.travel]
    axes.plot(s, np.degrees(trace.work), color=OURS, lw=1.2, label="work")
    axes.plot(s, np.degrees(trace.travel), color=TORCH, lw=1.6, ls="--", label="travel")
    if trace.predicted is not None:
        axes.plot(
            s, np.degrees(trace.predicted), color="black", lw=0.9, ls=":", label="travel, predicted from the seam"
        )
        values.append(trace.predicted)
    top = 1.6 * max(2.0, float(np.nanmax(np.abs(np.degrees(np.concatenate(values))), initial=0.0)))
    for limit, name, colour in zip(np.degrees(trace.windows), ("work", "travel"), (OURS, TORCH), strict=True):
        if limit < top:
            for sign in (-1.0, 1.0):
                axes.axhline(sign * limit, color=colour, lw=0.8, ls="--")
            _note(axes, f"limit of the {name} angle", float(limit), "top")
    axes.set_ylim(-top, top)
    axes.axhline(0.0, color="black", lw=0.6)
    axes.legend(frameon=False, fontsize=_SMALL, ncols=3, loc="upper left")
    plain(axes, "", "angle of\nthe torch, deg")


def _not_steering(axes: Axes, trace: WeldTrace) -> None:
    """Grey where the tip does not steer; a line where the arc was switched on and off."""
    s = np.where(np.isfinite(trace.s), trace.s, np.roll(trace.s, -1))  # of the gap before another seam
    edges = np.flatnonzero(np.diff(np.concatenate([[False], ~trace.felt, [False]]).astype(int)))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        axes.axvspan(1e3 * s[a], 1e3 * s[min(b, len(s) - 1)], color="black", alpha=0.07, lw=0)
    on = np.flatnonzero(trace.torch_on)
    for k in on[[0, -1]] if len(on) else ():
        axes.axvline(1e3 * s[k], color="black", lw=0.7, ls=":")


def weld_traces(weld: WeldOutcome, cell: Cell[WeldJob], root: Context) -> dict[str, WeldTrace]:
    """The weld for the pictures by the names of its seams and passes, such as 1 and 1_pass_2."""
    plans = cell.job.planned_seam(root).records or (SeamRecord(seam=0, line=weld.planned),)
    parts, passes = welds(weld.log)[: len(plans)], cell.scenario.welding.later_passes()
    lit = [k for k, part in enumerate(parts) if (part & weld.log.torch_on).any()]
    errors = dict(zip(lit, weld.seams, strict=True)) if len(lit) == len(weld.seams) else {}
    of_seam: dict[tuple[int, int], list[int]] = {}
    for k, plan in enumerate(plans[: len(parts)]):
        of_seam.setdefault((plan.seam, plan.weld_pass), []).append(k)
    found = {}
    for (seam, number), of_it in of_seam.items():
        true = true_seam(cell.station.truth, seam)
        if true is not None and number:
            true = true.raised(passes[number - 1].vertical_m, passes[number - 1].lateral_m)
        s = np.full(len(weld.log.time), np.nan)
        for k in of_it:
            s[parts[k]] = plans[k].place(weld.log.telemetry["s_torch"][parts[k]])
        of_plan = weld.plan_error if of_it[-1] == len(parts) - 1 and not number else None
        off = ([of_plan] if of_plan else [], [errors[k] for k in of_it if k in errors])
        trace = weld_trace(weld, cell.job.servo_config, s, off)
        if len(trace.s) > 1:
            name = f"{seam + 1}" + f"_pass_{number + 1}" * bool(number)
            found[name] = replace(trace, planned=_line(plans[of_it[-1]].line), true=_line(true))
    return found


def weld_trace(weld: WeldOutcome, config: ServoConfig, place: Array, off: Sequence[Sequence[PathError]]) -> WeldTrace:
    """Return the weld for the pictures where it has a place (N,) m along the seam; `off`: errors of plan and torch.

    ``y`` of the base is drawn to the right, as in the cell.
    """
    log, named = weld.log, weld.log.telemetry
    keep = np.isfinite(place) & (named["phase"] != list(Phase).index(Phase.TOUCH))  # the search has no place
    along = np.outer(np.nan_to_num(named["s_torch"]), [1.0, 0.0, 0.0])  # without the swings of a weave
    speed = speed_along(log.time, along if config.weave.amplitude_m else log.p_BTorch)
    errors: list[tuple[Array, Array, Array] | None] = []
    for parts in off:
        s, left, up = (np.concatenate([[], *(getattr(e, n) for e in parts)]) for n in ("s", "lateral", "height"))
        errors.append((broken(s, np.flatnonzero(np.abs(np.diff(s)) > APART_M) + 1), left, up) if parts else None)
    legs = np.flatnonzero(np.diff(log.time[keep]) > NEXT_SEAM_S) + 1
    return WeldTrace(
        s=broken(place[keep], legs),
        torch_on=log.torch_on[keep],
        felt=named["phase"][keep] == list(Phase).index(Phase.TRACK),
        tip=broken(log.p_BTip[keep], legs),
        torch=broken(log.p_BTorch[keep], legs),
        robot=broken(log.p_BRobot[keep], legs),
        planned=None,
        true=None,
        plan_error=errors[0],
        torch_error=errors[1],
        delta_n=named["delta_n"][keep],
        delta_axial=named["delta_axial"][keep],
        speed=speed[keep],
        omega=named["omega"][keep],
        n_d_dot_n_t=named["n_d_dot_n_t"][keep],
        weld_speed=config.weld_speed_m_s,
        delta_d=config.deflection.delta_d_m,
        axial_d=config.deflection.axial_d_m,
        omega_max=config.limits.omega_max_rad_s,
        e_t=named["e_t"][keep],
        work=log.work[keep],
        travel=log.travel[keep],
        windows=(config.windows.work_rad, config.windows.travel_rad),
        axes=(1, 0),
        names=("y, mm", "x, mm"),
    )


def _line(seam: SeamCurve | None) -> Array | None:
    return None if seam is None else np.asarray(seam.position(np.linspace(0.0, seam.length, 400)))


def arc_along_seam(record: WeldRecord, rows: NDArray[np.bool_], limits: OrderLimits) -> bytes | None:
    """Draw current, voltage, wire feed, travel speed and gap of these rows (N,) along the seam; None without an arc.

    Measured values are lines, one for each piece; set values dashed, limits grey bands.
    """
    pieces = [piece for piece in burns(record, np.flatnonzero(rows & record.arc)) if len(piece) > 1]
    if not pieces:
        return None
    s = place_mm(record)
    s = s if np.isfinite(s[pieces[0]]).all() else record["time_s"]  # of a log of before
    wire = 1e3 * record["torch_speed_m_s"] if record.settings.get("woven") else None
    curves = [
        ("current, A", record["current_A"], record["set_current_A"], limits.current_A),
        ("voltage, V", record["voltage_V"], record["set_voltage_V"], limits.voltage_V),
        ("wire feed,\nm/min", None, record["set_wire_feed_m_min"], None),
        ("travel speed,\nmm/s", 1e3 * travel_speed(record), None, limits.speed_mm_s),
        ("woven wire,\nmm/s", wire, None, None),
        ("gap, mm", 1e3 * record["gap_m"], None, None),
    ]
    on = np.concatenate(pieces)
    shown = [c for c in curves if any(v is not None and np.isfinite(v[on]).any() for v in c[1:3])]
    figure, axes = subplots(8.2, _INCH * len(shown) + 0.3, len(shown), 1, sharex=True, squeeze=False)
    for ax, (name, measured, wanted, limit) in zip(axes[:, 0], shown, strict=True):
        extremes = [] if limit is None else [*limit]
        if limit is not None:
            ax.axhspan(*limit, color=GREY, alpha=0.18, lw=0, label="limits")
        for k, piece in enumerate(pieces):
            label = "_" * bool(k)  # one piece is named in the legend
            if measured is not None and np.isfinite(measured[on]).any():
                smooth = _smooth(record["time_s"][piece], measured[piece])
                ax.plot(s[piece], measured[piece], color=GREY, lw=0.5)
                ax.plot(s[piece], smooth, color=OURS, lw=1.3, label=f"{label}measured")
                extremes += [smooth.min(), smooth.max()]
            if wanted is not None and np.isfinite(wanted[on]).any():
                ax.plot(s[piece], wanted[piece], color=TORCH, lw=1.2, ls="--", label=f"{label}set")
                extremes += [np.nanmin(wanted[on]), np.nanmax(wanted[on])]
        low, high = min(extremes), max(extremes)
        spare = max(0.25 * (high - low), 0.1 * abs(high), 1e-3)
        ax.set_ylim(low - spare, high + spare)
        ax.legend(frameon=False, fontsize=_SMALL, ncols=3, loc="lower center")
        plain(ax, "", name)
    axes[-1, 0].set_xlabel("along the seam, mm")
    return svg(figure, *axes[:, 0])


def _smooth(t: Array, value: Array) -> Array:
    """The running mean (N,) over _SMOOTH_S."""
    known = np.nan_to_num(value)
    total = np.concatenate([[0.0], np.cumsum(known)])
    first = np.searchsorted(t, t - 0.5 * _SMOOTH_S)
    last = np.searchsorted(t, t + 0.5 * _SMOOTH_S, side="right")
    return np.asarray((total[last] - total[first]) / (last - first))
