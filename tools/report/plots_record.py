"""Plot of a welded seam for its record: what the power source was set to and gave, over the time of the arc."""

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.tools.report.pictures import GREY, OURS, TORCH, plain, subplots, svg
from weldcal.welding.record.order import OrderLimits
from weldcal.welding.record.weld_log import WeldRecord

_SMALL = 8
_INCH = 1.35  # height of one curve
_SMOOTH_S = 0.2  # a choice: a reader's eye takes the mean of a pulsed or noisy arc


def arc_over_time(record: WeldRecord, rows: NDArray[np.bool_], limits: OrderLimits) -> bytes | None:
    """Draw current, voltage, wire feed, travel speed and gap while the arc of these rows (N,) burns; None without one.

    Measured values are lines, set values dashed, limits grey bands.
    """
    on = np.flatnonzero(rows & record.arc)
    if len(on) < 3:
        return None
    t = record["time_s"][on] - record["time_s"][on[0]]
    curves = [
        ("current, A", record["current_A"][on], record["set_current_A"][on], limits.current_A),
        ("voltage, V", record["voltage_V"][on], record["set_voltage_V"][on], limits.voltage_V),
        ("wire feed,\nm/min", None, record["set_wire_feed_m_min"][on], None),
        ("travel speed,\nmm/s", 1e3 * record["torch_speed_m_s"][on], None, limits.speed_mm_s),
        ("gap, mm", 1e3 * record["gap_m"][on], None, None),
    ]
    shown = [c for c in curves if any(v is not None and np.isfinite(v).any() for v in c[1:3])]
    figure, axes = subplots(8.2, _INCH * len(shown) + 0.3, len(shown), 1, sharex=True, squeeze=False)
    for ax, (name, measured, wanted, limit) in zip(axes[:, 0], shown, strict=True):
        if limit is not None:
            ax.axhspan(*limit, color=GREY, alpha=0.18, lw=0, label="limits")
        if measured is not None and np.isfinite(measured).any():
            ax.plot(t, measured, color=GREY, lw=0.5)
            ax.plot(t, _smooth(t, measured), color=OURS, lw=1.3, label="measured")
        if wanted is not None and np.isfinite(wanted).any():
            ax.plot(t, wanted, color=TORCH, lw=1.2, ls="--", label="set")
        low, high = ax.get_ylim()
        ax.set_ylim(min(low, 0.0) if name.startswith(("travel", "gap")) else low, high)
        ax.legend(frameon=False, fontsize=_SMALL, ncols=3, loc="lower center")
        plain(ax, "", name)
    axes[-1, 0].set_xlabel("time from the established arc, s")
    return svg(figure, *axes[:, 0])


def _smooth(t: Array, value: Array) -> Array:
    """The running mean (N,) over _SMOOTH_S."""
    known = np.nan_to_num(value)
    total = np.concatenate([[0.0], np.cumsum(known)])
    first = np.searchsorted(t, t - 0.5 * _SMOOTH_S)
    last = np.searchsorted(t, t + 0.5 * _SMOOTH_S, side="right")
    return np.asarray((total[last] - total[first]) / (last - first))
