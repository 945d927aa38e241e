"""What following a flange does with every pixel of its window, compiled: points of its plane, borders, pixels near an edge."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.circle_steps import MAD, TUKEY, middle, solved
from weldcal.calibration.geometry.compiled import compiled

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

_FEW = 600  # points that find a plane and its noise; then all of them


@compiled()
def ring_points(
    z: Single, turned: Array, at: Array, step: int, inner: float, outer: float, tall: float
) -> tuple[Array, Index]:
    """Of every ``step``-th pixel of depths (h, w) m along rows and columns those on a ring about a point.

    ``turned`` (3, 3) are the coefficients of the rays in axes whose third is the normal, ``at`` (3,) the point in them;
    ``inner``, ``outer`` and ``tall`` m bound the ring. Returns (x, y, height) (3, N) m about the point and the indices
    (N,) in the image of those pixels.
    """
    h, w = (z.shape[0] + step - 1) // step, (z.shape[1] + step - 1) // step
    out, index = np.empty((3, h * w)), np.empty(h * w, np.int64)
    inner2, outer2 = inner * inner, outer * outer
    n = 0
    for j in range(h):
        v = float(j * step)
        rx, ry, rz = turned[0, 0] + turned[2, 0] * v, turned[0, 1] + turned[2, 1] * v, turned[0, 2] + turned[2, 2] * v
        for i in range(w):
            u = float(i * step)
            depth = float(z[j * step, i * step])
            x = depth * (rx + turned[1, 0] * u) - at[0]
            y = depth * (ry + turned[1, 1] * u) - at[1]
            d = depth * (rz + turned[1, 2] * u) - at[2]
            rho2 = x * x + y * y
            if rho2 > inner2 and rho2 < outer2 and abs(d) < tall:  # false for what was not measured
                out[0, n], out[1, n], out[2, n], index[n] = x, y, d, j * w + i
                n += 1
    return out[:, :n].copy(), index[:n].copy()


@compiled()
def plane_steps(p: Array, tolerance: float) -> tuple[bool, Array, Array, float, Array]:
    """The plane height = a + b x + c y through points (3, N) m by Tukey's weights, from the median height on.

    Returns whether more than three points in ten agree, (a, b, c), the moments (3, 3) of (1, x, y) with those weights, the
    residual beyond which a point says nothing and all residuals (N,).
    """
    n = p.shape[1]
    few = max(1, n // _FEW)
    size = np.empty((n + few - 1) // few)
    for i in range(len(size)):
        size[i] = p[2, i * few]
    fit = np.array([middle(size), 0.0, 0.0])
    limit = 2.0 * tolerance
    M, e = np.zeros((3, 3)), np.empty(n)
    for step in range(4):
        stride = few if step < 2 else 1
        used = 0
        for i in range(0, n, stride):
            e[used] = p[2, i] - (fit[0] + fit[1] * p[0, i] + fit[2] * p[1, i])
            used += 1
        if step:
            skip = max(1, used // _FEW)
            m = 0
            for i in range(0, used, skip):
                if m < len(size):
                    size[m] = abs(e[i])
                    m += 1
            limit = TUKEY * max(MAD * middle(size[:m]), 2e-5)
        k = 1.0 / limit
        M, g = np.zeros((3, 3)), np.zeros(3)
        for j in range(used):
            i = j * stride
            inside = max(1.0 - (e[j] * k) ** 2, 0.0)
            wt = inside * inside
            x, y, d = p[0, i], p[1, i], p[2, i]
            wx, wy = wt * x, wt * y
            M[0, 0] += wt
            M[1, 0] += wx
            M[2, 0] += wy
            M[1, 1] += wx * x
            M[2, 1] += wx * y
            M[2, 2] += wy * y
            g[0] += wt * d
            g[1] += wx * d
            g[2] += wy * d
        M[0, 1], M[0, 2], M[1, 2] = M[1, 0], M[2, 0], M[2, 1]
        if not M[0, 0] > 0.3 * used:
            return False, fit, M, limit, e
        ok, fit = solved(M, g, 3)
        if not ok:
            return False, fit, M, limit, e
    for i in range(n):
        e[i] = p[2, i] - (fit[0] + fit[1] * p[0, i] + fit[2] * p[1, i])
    return True, fit, M, limit, e


@compiled()
def borders(face: Mask, known: Mask, turned: Array, at: Array, near: Array) -> tuple[Single, Mask, Index]:
    """Where the face (h, w) ends between two neighbouring pixels that both say something.

    ``turned`` and ``at`` as in ``places``; ``near`` (2,) m is a point on the plane. Returns the places (2, N) m about it
    in its axes, whether the face lies on the inner side of each, and the flat index of the pixel off the face.
    """
    h, w = face.shape
    first, down = np.empty(2 * h * w, np.int64), np.empty(2 * h * w, np.bool_)
    n = 0
    for v in range(h):
        row, below = face[v], face[min(v + 1, h - 1)]
        for u in range(w - 1):
            if row[u] != row[u + 1] and known[v, u] and known[v, u + 1]:
                first[n], down[n] = v * w + u, False
                n += 1
            if row[u] != below[u] and known[v, u] and known[v + 1, u]:
                first[n], down[n] = v * w + u, True
                n += 1
    out, inward, beyond = np.empty((2, n), np.float32), np.empty(n, np.bool_), np.empty(n, np.int64)
    for i in range(n):
        v, u, k = first[i] // w, first[i] % w, 1 + int(down[i])
        half_u, half_v = u + 0.5 * (2 - k), v + 0.5 * (k - 1)
        sz = turned[0, 2] + turned[1, 2] * half_u + turned[2, 2] * half_v
        sx = turned[0, 0] + turned[1, 0] * half_u + turned[2, 0] * half_v
        sy = turned[0, 1] + turned[1, 1] * half_u + turned[2, 1] * half_v
        along = at[2] / sz
        x, y = along * sx - at[0] - near[0], along * sy - at[1] - near[1]
        # which way the place moves with the pixel
        mx = along * (turned[k, 0] - sx * turned[k, 2] / sz)
        my = along * (turned[k, 1] - sy * turned[k, 2] / sz)
        on = face[v, u]
        out[0, i], out[1, i] = x, y
        inward[i] = (x * mx + y * my > 0.0) == on
        beyond[i] = first[i] + (w if down[i] else 1) if on else first[i]
    return out, inward, beyond


@compiled()
def near_edge(
    face: Mask,
    known: Mask,
    turned: Array,
    at: Array,
    center: Array,
    radius: float,
    reach: float,
    lowered: float,
    pitch: float,
    block: int,
) -> tuple[Single, Mask]:
    """Pixels that say something within ``reach`` m of a circle on the plane: places (2, N) m about its centre, and which
    lie on the face (N,). The face may end ``lowered`` m below the plane. Blocks of pixels are looked at first."""
    h, w = face.shape
    out, on = np.empty((2, h * w), np.float32), np.empty(h * w, np.bool_)
    lower = lowered / at[2]
    half = 0.5 * (block - 1)
    from2, to2 = max(radius - reach, 0.0) ** 2, (radius + reach) ** 2
    # the middle of a block's corner pixel lies so far from its own, and a leaning face stretches them
    wide = reach + lowered + 0.6 * block * pitch
    block_from2, block_to2 = max(radius - wide, 0.0) ** 2, (radius + wide) ** 2
    n = 0
    for j in range(0, h, block):
        for i in range(0, w, block):
            along = at[2] / (turned[0, 2] + turned[1, 2] * (i + half) + turned[2, 2] * (j + half))
            x = along * (turned[0, 0] + turned[1, 0] * (i + half) + turned[2, 0] * (j + half)) - at[0] - center[0]
            y = along * (turned[0, 1] + turned[1, 1] * (i + half) + turned[2, 1] * (j + half)) - at[1] - center[1]
            if not block_from2 < x * x + y * y < block_to2:
                continue
            for v in range(j, min(j + block, h)):
                for u in range(i, min(i + block, w)):
                    if not known[v, u]:
                        continue
                    along = at[2] / (turned[0, 2] + turned[1, 2] * u + turned[2, 2] * v)
                    px = along * (turned[0, 0] + turned[1, 0] * u + turned[2, 0] * v)
                    py = along * (turned[0, 1] + turned[1, 1] * u + turned[2, 1] * v)
                    x, y = px - lower * px - at[0] - center[0], py - lower * py - at[1] - center[1]
                    if from2 < x * x + y * y < to2:
                        out[0, n], out[1, n], on[n] = x, y, face[v, u]
                        n += 1
    return out[:, :n].copy(), on[:n].copy()
