"""The report page of `weldcal hand-eye`: the poses, how sure each component is, the errors of every sample, the comparison of methods."""

from collections.abc import Mapping

import numpy as np

from weldcal.calibration.hand_eye.mountings import Mounting
from weldcal.calibration.hand_eye.opencv_methods import most_compared
from weldcal.calibration.hand_eye.solve import HandEyeResult
from weldcal.tools.outcomes.hand_eye import HandEyeReport
from weldcal.tools.report.pictures import error_bars
from weldcal.tools.report.render import fixed, render

Table = tuple[str, list[tuple[str, str, str]]]


def hand_eye_report(report: HandEyeReport, source: str, digest: str) -> str:
    """The whole report as one self-contained HTML text; ``digest`` is the SHA-256 of the file."""
    r, m = report.result, report.mounting
    names = [str(k) for k in range(len(r.inliers))]
    held, turned = 1e3 * r.held_out.translation, np.degrees(r.held_out.rotation_rad)
    judged = bool(np.isfinite(held).any())
    rows = [
        (name, "used" if used else "left out", fixed(a, 3), fixed(b, 4), fixed(c, 3), fixed(d, 4))
        for name, used, a, b, c, d in zip(
            names, r.inliers, held, turned, 1e3 * r.translation, np.degrees(r.rotation_rad), strict=True
        )
    ]
    most = most_compared(len(r.inliers))
    return render(
        "hand_eye.html.j2",
        first=report.first,
        name=m.name,
        source=source,
        words=m.words,
        equation=m.equation,
        paper=m.source,
        sketch=m.sketch,
        r=r,
        judged=judged,
        n=len(r.inliers),
        diversity=r.diversity.sentence(),
        held_mm=1e3 * r.held_out.rms_translation,
        held_deg=r.held_out.rms_deg,
        unknowns=unknown_tables(r, m, {}),
        bars=error_bars(names, held, r.inliers, "held-out error, mm") if judged else None,
        tilts=error_bars(names, turned, r.inliers, "held-out rotation, deg") if np.isfinite(turned).any() else None,
        rows=rows,
        comparison=[(c.method, fixed(c.mm, 3), fixed(c.deg, 4)) for c in report.comparison],
        few=most if 0.8 * len(r.inliers) > most else None,
        streams=None if report.streams is None else report.streams.sentence,
        corners=report.corners,
        seconds=report.seconds,
        digest=digest,
    )


def unknown_tables(result: HandEyeResult, mounting: Mounting, off: Mapping[str, str]) -> list[Table]:
    """For each pose a caption and rows: component, value, one sigma; ``off`` adds words to the caption, by the pose's symbol."""
    found = []
    for k, X in result.poses.items():
        u, sigma = mounting.unknowns[k], np.sqrt(np.diag(result.covariance[k]))
        rpy = np.degrees(X.rotation().ToRollPitchYaw().vector())
        lengths = zip(("x, mm", "y, mm", "z, mm"), 1e3 * X.translation(), 1e3 * sigma[3:], strict=True)
        angles = zip(("roll, deg", "pitch, deg", "yaw, deg"), rpy, np.degrees(sigma[:3]), strict=True)
        cells = [(name, fixed(v, 3), _spread(s, 3, 1e3)) for name, v, s in lengths]
        cells += [(name, fixed(v, 4), _spread(s, 4, 57.3)) for name, v, s in angles]
        found.append((u.sentence[0].upper() + u.sentence[1:] + off.get(u.symbol, ""), cells))
    return found


def _spread(sigma: float, digits: int, certain: float) -> str:
    return "open" if sigma > certain else fixed(float(sigma), digits)
