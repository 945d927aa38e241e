"""The smallest optimisation that a servo tick needs: least squares in two unknowns inside a box, in closed form."""

from __future__ import annotations

from weldcal.welding.vectors import clip


def box_least_squares(
    rows: tuple[tuple[float, float, float, float], ...],
    x_bounds: tuple[float, float],
    y_bounds: tuple[float, float],
) -> tuple[float, float]:
    """Minimise sum w (a x + b y - c)^2 over a box, exactly.

    Args:
        rows: (w, a, b, c), weight first.
        x_bounds, y_bounds: (low, high); an empty interval collapses to its low end.

    Returns:
        (x, y) inside the box. A convex quadratic in a box is least inside, or on one of the four edges.
    """
    hxx = hxy = hyy = gx = gy = 0.0
    for w, a, b, c in rows:
        hxx += w * a * a
        hxy += w * a * b
        hyy += w * b * b
        gx += w * a * c
        gy += w * b * c
    # A ridge a billionth of the largest term keeps the division defined when a direction costs nothing.
    ridge = 1e-9 * (hxx + hyy) + 1e-30
    hxx += ridge
    hyy += ridge
    xl, xh = x_bounds[0], max(x_bounds)
    yl, yh = y_bounds[0], max(y_bounds)
    det = hxx * hyy - hxy * hxy
    if det > 0.0:
        x, y = (gx * hyy - gy * hxy) / det, (gy * hxx - gx * hxy) / det
        if xl <= x <= xh and yl <= y <= yh:
            return x, y
    best, answer = float("inf"), (xl, yl)
    candidates = [(x, clip((gy - hxy * x) / hyy, yl, yh)) for x in (xl, xh)]
    candidates += [(clip((gx - hxy * y) / hxx, xl, xh), y) for y in (yl, yh)]
    for x, y in candidates:
        cost = hxx * x * x + 2.0 * hxy * x * y + hyy * y * y - 2.0 * (gx * x + gy * y)
        if cost < best:
            best, answer = cost, (x, y)
    return answer
