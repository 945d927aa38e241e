"""What a camera would see of the page: rings or single pixels, projected, blurred, unevenly lit and noisy."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

Array = NDArray[np.float64]
FINE = 6  # sub-pixels per pixel and axis


def project(X_CT: RigidTransform, points_m: Array, K: Array) -> Array:
    """Image positions (n, 2) px of points (n, 2) m of the tablet."""
    p = X_CT.multiply(np.c_[points_m, np.zeros(len(points_m))].T)
    return (K[:2, :2] @ (p[:2] / p[2])).T + K[:2, 2]


def grid(columns: int, rows: int, across_m: float, down_m: float) -> Array:
    """Landmarks (rows * columns, 2) m of the page, the first at the origin."""
    return np.array([[i * across_m, j * down_m] for j in range(rows) for i in range(columns)])


def picture(
    X_CT: RigidTransform,
    landmarks_m: Array,
    K: Array,
    *,
    size: tuple[int, int] = (640, 480),
    look: str = "rings",
    ring_m: float = 8e-3,
    dot_m: float = 0.19e-3,
    blur_px: float = 0.8,
    noise: float = 2.0,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """The image (h, w), 8 bits; the tablet's white screen ends 25 mm beyond its landmarks, on a dark table."""
    width, height = size
    canvas = np.full((height * FINE, width * FINE), 60.0, dtype=np.float32)

    def fill(outline_m: Array, grey: float) -> None:
        fine = (project(X_CT, outline_m, K) + 0.5) * FINE - 0.5
        cv2.fillPoly(canvas, [np.round(fine * 16).astype(np.int32)], grey, cv2.LINE_8, 4)

    angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    circle = np.c_[np.cos(angle), np.sin(angle)]
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    low, high = landmarks_m.min(axis=0) - 0.025, landmarks_m.max(axis=0) + 0.025
    fill(np.array([low, [high[0], low[1]], high, [low[0], high[1]]]), 215.0)
    for k, p in enumerate(landmarks_m):
        if look == "rings":
            fill(p + 0.5 * ring_m * circle, 15.0)
            if k > 0:
                fill(p + 0.62 * 0.5 * ring_m * circle, 215.0)
        else:
            fill(p + dot_m * square, 15.0)
    seen = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
    seen = cv2.GaussianBlur(seen, (0, 0), blur_px) if blur_px > 0.0 else seen
    light = 1.0 - 0.25 * np.linspace(0.0, 1.0, width)[None, :] - 0.1 * np.linspace(0.0, 1.0, height)[:, None]
    lit = seen * light + np.random.default_rng(seed).normal(0.0, noise, seen.shape)
    return np.clip(np.round(lit), 0, 255).astype(np.uint8)
