"""The steps of a robust circle fit, compiled: most of a small fit's time is the number of its array operations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.compiled import compiled

Array = NDArray[np.float64]

TUKEY = 4.685  # 95 % efficient on Gaussian noise
MAD = 1.4826  # median absolute deviation -> standard deviation of a Gaussian
_STEPS = 7
_FLAT = 1e-9  # of a diagonal element, what earlier rows leave of it: less, and the arc is too short


@compiled()
def middle(a: Array) -> float:
    """The middle one of numbers (N,) by size, the upper of two; they are put into another order (Hoare's selection)."""
    low, high, k = 0, len(a) - 1, len(a) // 2
    while low < high:
        pivot, i, j = a[(low + high) // 2], low, high
        while i <= j:
            while a[i] < pivot:
                i += 1
            while a[j] > pivot:
                j -= 1
            if i <= j:
                a[i], a[j] = a[j], a[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return float(a[k])


@compiled()
def solved(N: Array, g: Array, free: int) -> tuple[bool, Array]:
    """Whether the leading ``free`` rows of a symmetric matrix (3, 3) are positive definite, and x with N x = g (Cholesky)."""
    L, x = np.zeros((3, 3)), np.zeros(3)
    for i in range(free):
        for j in range(i + 1):
            s = N[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > _FLAT * N[i, i]:
                    return False, x
                L[i, i] = np.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(free):
        s = g[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(free - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, free):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return True, x


@compiled()
def circle_steps(
    x: Array, y: Array, radius: float, free: int, noise_floor: float, settled: float
) -> tuple[bool, Array, Array, float, float, NDArray[np.bool_]]:
    """Gauss-Newton with Tukey's weights for one circle about the origin of its points x, y (N,) m; ``free`` is 2 where the
    radius is known, else 3.

    The scale is the one of the third step. Returns whether the points fix a circle, (cx, cy, r), the information J^T J
    (3, 3), the variance of psi over its mean slope squared, the rms of the inliers, and which those are (N,).
    """
    n = len(x)
    theta, new = np.zeros(3), np.array([0.0, 0.0, radius])
    e, t2, size, inliers = np.empty(n), np.empty(n), np.empty(n), np.zeros(n, np.bool_)
    scale = noise_floor
    for step in range(_STEPS):
        for j in range(3):
            theta[j] = new[j]
        for i in range(n):
            dx, dy = x[i] - theta[0], y[i] - theta[1]
            e[i] = np.sqrt(dx * dx + dy * dy) + 1e-15 - theta[2]
            size[i] = abs(e[i])
        if step < 3:
            scale = max(MAD * middle(size), noise_floor)
        k = 1.0 / (TUKEY * scale)
        N, g = np.zeros((3, 3)), np.zeros(3)
        for i in range(n):
            t2[i] = (e[i] * k) ** 2
            inside = max(1.0 - t2[i], 0.0)
            w = inside * inside
            rho = e[i] + theta[2]
            a, b = (x[i] - theta[0]) / rho, (y[i] - theta[1]) / rho
            N[0, 0] += w * a * a
            N[1, 0] += w * a * b
            N[1, 1] += w * b * b
            N[2, 0] += w * a
            N[2, 1] += w * b
            N[2, 2] += w
            g[0] += w * a * e[i]
            g[1] += w * b * e[i]
            g[2] += w * e[i]
        ok, change = solved(N, g, free)
        if not ok:
            return False, theta, N, 0.0, 0.0, inliers
        for j in range(3):
            new[j] = theta[j] + change[j]
        if step > 2 and max(abs(change[0]), abs(change[1]), abs(change[2])) < settled:
            break
    psi2 = slope = squares = 0.0
    count = 0
    N = np.zeros((3, 3))
    for i in range(n):
        rho = e[i] + theta[2]
        a, b = (x[i] - theta[0]) / rho, (y[i] - theta[1]) / rho
        N[0, 0] += a * a
        N[1, 0] += a * b
        N[1, 1] += b * b
        N[2, 0] += a
        N[2, 1] += b
        inside = 1.0 - t2[i]
        if inside > 0.0:
            inliers[i] = True
            psi2 += (e[i] * inside * inside) ** 2
            slope += inside * (1.0 - 5.0 * t2[i])
            squares += e[i] * e[i]
            count += 1
    N[0, 1], N[0, 2], N[1, 2], N[2, 2] = N[1, 0], N[2, 0], N[2, 1], float(n)
    variance = psi2 / max(n - 3, 1) / max(slope / n, 0.2) ** 2
    return True, new, N, variance, np.sqrt(squares / max(count, 1)), inliers
