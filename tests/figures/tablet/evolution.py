"""The tablet paper's optimiser at its own size: DE/rand/1/bin over its two fitness functions, both compiled."""

import numpy as np

from tests.worlds.tablet import STAGE_1
from weldcal.calibration.tablet.published import (
    AFFINE_RANGE,
    CENTRE,
    Landmarks,
    Model,
    Sign,
    StageResult,
    fitness,
    place_landmarks,
    search_range,
    stage1_residuals,
    stage2_residuals,
)
from weldcal.calibration.tablet.touches import TabletTouches
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled

POPULATION = GENERATIONS = 10_000  # N and G of Table 4
SMALL_POPULATION, SMALL_GENERATIONS = 240, 1250  # 3e5 evaluations end at the same minimum
_CROSSOVER, _WEIGHT = 0.9, 0.5  # CR and F of Table 4
_KINDS = {("htm", 1): 0, ("dh", 1): 1, ("htm", 2): 2, ("dh", 2): 2}


def evolve(
    touches: TabletTouches, model: Model, stage: int, seed: int, population: int, generations: int
) -> StageResult:
    """One stage as the paper found it, with the sign of Eq. 20 as printed; stage 2 from the printed stage 1."""
    search = search_range(model) if stage == 1 else AFFINE_RANGE
    x = _evolve(
        _KINDS[model, stage], _rows(touches, model, stage), search, np.random.default_rng(seed), population, generations
    )
    if stage == 1:
        residuals = stage1_residuals(touches, x, model, Sign.PRINTED)[0]
    else:
        placed = place_landmarks(touches, STAGE_1[model].parameters, model)
        residuals = stage2_residuals(touches, x, placed, Sign.PRINTED)[0]
    return StageResult(x, fitness(residuals), population * (generations + 1))


def cost(touches: TabletTouches, model: Model, stage: int, parameters: Array) -> Array:
    """F of Eq. 17 or 21 (k,) mm by the compiled function, for parameter sets (k, p)."""
    rows = _rows(touches, model, stage)
    return np.array([_cost(_KINDS[model, stage], x, rows) for x in np.atleast_2d(parameters)])


def _rows(touches: TabletTouches, model: Model, stage: int) -> Array:
    """What a fitness function needs of each landmark, mm, with the sign of Eq. 20 as printed."""
    hand = 1e3 * touches.hand_m
    if stage == 2:
        placed: Landmarks = place_landmarks(touches, STAGE_1[model].parameters, model)
        return np.hstack([placed.seen[0], placed.shown[0], placed.pen[0], hand - placed.correction[0]])
    depth = 1e3 * touches.depth_m[:, None]
    theta, capture = touches.theta_rad, np.tile(1e3 * touches.hand_capture_m[:2], (len(hand), 1))
    tablet, delta = 1e3 * touches.landmark_m, 1e3 * touches.pitch_m * touches.delta_px
    return np.hstack([touches.rays * depth, depth, tablet, delta, np.c_[np.cos(theta), np.sin(theta)], hand, capture])


@compiled()
def _cost(kind: int, x: Array, rows: Array) -> float:
    return _stage2(x, rows) if kind == 2 else _stage1(kind == 1, x, rows)


@compiled()
def _stage1(dh: bool, x: Array, rows: Array) -> float:
    """Eq. 17 of the transforms, or of the DH chain."""
    if dh:
        c = _rotation(x[2], x[3], x[4] + 180.0 + x[0])
        t = _rotation(x[7], x[8], x[9] + x[5])
        cx, cy, tx, ty, mirror, extra = x[1], 0.0, x[6], 0.0, -1.0, x[6]
    else:
        c = _rotation(x[2] + 180.0, x[3] + 180.0, x[4])
        t = _rotation(x[7] + 180.0, x[8], x[9])
        cx, cy, tx, ty, mirror, extra = x[0], x[1], x[5], x[6], 1.0, 0.0
    total = 0.0
    for i in range(len(rows)):
        X, Y, Z, u, v, du, dv, cos, sin, hx, hy, bx, by = rows[i]
        sx = bx - (c[0] * X + c[1] * Y + c[2] * Z + cx)
        sy = by + c[3] * X + c[4] * Y + c[5] * Z + cy
        total += np.hypot(sx - (t[0] * u + t[1] * v + tx), sy - (mirror * (t[3] * u + t[4] * v) + ty))
        ex = sx - (-x[10] * cos + x[11] * sin) - (hx - (t[0] * du + t[1] * dv + extra))
        ey = sy - (x[10] * sin + x[11] * cos) - (hy - mirror * (t[3] * du + t[4] * dv))
        total += np.hypot(ex, ey)
    return total / len(rows)


@compiled()
def _stage2(x: Array, rows: Array) -> float:
    """Eq. 21: A_1 acts on the camera's landmarks, A_2 on what it gives minus the pen."""
    c1, s1 = np.cos(np.radians(x[4])), np.sin(np.radians(x[4]))
    c2, s2 = np.cos(np.radians(x[9])), np.sin(np.radians(x[9]))
    ax, ay = rows[CENTRE, 0], rows[CENTRE, 1]
    qx, qy = ax + x[0] - rows[CENTRE, 4], ay + x[1] - rows[CENTRE, 5]
    total = 0.0
    for i in range(len(rows)):
        X, Y, tx, ty, px, py, hx, hy = rows[i]
        dx, dy = x[2] * (X - ax), x[3] * (Y - ay)
        fx, fy = ax + c1 * dx - s1 * dy + x[0], ay + s1 * dx + c1 * dy + x[1]
        total += np.hypot(fx - tx, fy - ty)
        dx, dy = x[7] * (fx - px - qx), x[8] * (fy - py - qy)
        total += np.hypot(qx + c2 * dx - s2 * dy + x[5] - hx, qy + s2 * dx + c2 * dy + x[6] - hy)
    return total / len(rows)


@compiled()
def _rotation(alpha: float, beta: float, gamma: float) -> tuple[float, float, float, float, float, float]:
    """First two rows of Rz(gamma) Ry(beta) Rx(alpha), degrees."""
    ca, sa = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
    cb, sb = np.cos(np.radians(beta)), np.sin(np.radians(beta))
    cg, sg = np.cos(np.radians(gamma)), np.sin(np.radians(gamma))
    return (
        cg * cb,
        cg * sb * sa - sg * ca,
        cg * sb * ca + sg * sa,
        sg * cb,
        sg * sb * sa + cg * ca,
        sg * sb * ca - cg * sa,
    )


@compiled()
def _evolve(
    kind: int, rows: Array, search: Array, rng: np.random.Generator, population: int, generations: int
) -> Array:
    """Best parameters (p,) after all generations; what leaves the range is drawn anew, as SciPy does."""
    low, wide = search[:, 0].copy(), search[:, 1] - search[:, 0]
    p = len(low)
    now = low + wide * rng.random((population, p))
    value = np.array([_cost(kind, now[i], rows) for i in range(population)])
    after, trial = now.copy(), np.empty(p)
    for _ in range(generations):
        for i in range(population):
            a = b = c = i
            while a == i:
                a = int(population * rng.random())
            while b in (i, a):
                b = int(population * rng.random())
            while c in (i, a, b):
                c = int(population * rng.random())
            always = int(p * rng.random())
            for j in range(p):
                trial[j] = now[i, j]
                if j == always or rng.random() < _CROSSOVER:
                    trial[j] = now[a, j] + _WEIGHT * (now[b, j] - now[c, j])
                    if not low[j] <= trial[j] <= low[j] + wide[j]:
                        trial[j] = low[j] + wide[j] * rng.random()
            found = _cost(kind, trial, rows)
            if found <= value[i]:
                value[i] = found
                after[i] = trial
            else:
                after[i] = now[i]
        now, after = after, now
    best: Array = now[np.argmin(value)]
    return best
