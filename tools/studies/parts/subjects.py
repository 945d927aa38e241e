"""Subjects that a registration must refuse: parts that look the same elsewhere, the wrong part, the wrong unit."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from weldcal.models.errors import WeldcalError
from weldcal.models.mesh import TriMesh, revolve
from weldcal.tools.worlds.parts.plates import box
from weldcal.tools.worlds.parts.scenes import block, subject
from weldcal.welding.locate.part.result import AmbiguousPart, PartNotFound


@dataclass(frozen=True, eq=False)
class Refusal:
    """What lies in the scene, what is looked for, and the error with the words that must name why."""

    there: TriMesh
    looked_for: TriMesh
    error: type[WeldcalError]
    words: str
    twice: bool = False


def sphere(radius: float) -> TriMesh:
    """A ball standing on z = 0, m."""
    a = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 33)
    return revolve(np.column_stack([radius * np.cos(a) * (np.abs(a) < 1.57), radius * (1.0 + np.sin(a))]), 64)


def pipe(radius: float, wall: float, height: float) -> TriMesh:
    """A pipe standing on z = 0, m."""
    inner = radius - wall
    return revolve(np.array([[inner, 0.0], [radius, 0.0], [radius, height], [inner, height], [inner, 0.0]]), 72)


def _scaled(mesh: TriMesh, factor: float) -> TriMesh:
    return TriMesh(mesh.vertices * factor, mesh.triangles)


REFUSALS: dict[str, Callable[[], Refusal]] = {
    "plain plate": lambda: Refusal(box(0.2, 0.12, 0.012), box(0.2, 0.12, 0.012), AmbiguousPart, "turning it about its"),
    "plain pipe": lambda: Refusal(
        pipe(0.05, 0.005, 0.09), pipe(0.05, 0.005, 0.09), AmbiguousPart, "free to turn about its z axis|looks the same"
    ),
    "sphere": lambda: Refusal(sphere(0.05), sphere(0.05), AmbiguousPart, "free to turn about its|looks the same"),
    "two alike": lambda: Refusal(block(), block(), AmbiguousPart, "Two places in the scan", twice=True),
    "another part": lambda: Refusal(block(), subject("lap").mesh, PartNotFound, "part"),
    "another length": lambda: Refusal(box(0.2, 0.12, 0.03), box(0.26, 0.12, 0.03), PartNotFound, "part"),
    "wrong unit": lambda: Refusal(block(), _scaled(block(), 25.4), PartNotFound, "part"),
    "not there": lambda: Refusal(box(0.03, 0.03, 0.02), block(), PartNotFound, "part"),
}
