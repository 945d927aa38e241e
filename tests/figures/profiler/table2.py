"""Table 2 of the sphere paper: what it does not state is varied, one at a time, and the compensated method measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from tests.figures.harness import Row
from tests.figures.profiler.papers import (
    MM,
    PRINTED_POINTS,
    PRINTED_SEAM,
    SEAM_FEATURES,
    SPHERE_METHODS,
    measured,
    published_records,
    seam_features,
    sensed_and_touched,
)
from tests.worlds.profiler import SphereWorld, WorldData, scan_groove, sphere_trial
from weldcal.calibration.profiler.motion import Floats
from weldcal.tools.report.render import fixed

World = Callable[[SphereWorld], SphereWorld]


def _same(world: SphereWorld) -> SphereWorld:
    return world


def _errors(**changes: float) -> World:
    return lambda world: replace(world, errors=replace(world.errors, **changes))


def _sensor(share: float, bend: float) -> World:
    def change(world: SphereWorld) -> SphereWorld:
        return replace(
            world,
            sensor=np.eye(2) + share * (world.sensor - np.eye(2)),
            offset=share * world.offset,
            bend=bend * world.bend,
        )

    return change


def _arm(world: SphereWorld) -> SphereWorld:
    return replace(world, real=world.cell.arm, sag=np.zeros(2))


def _near(world: SphereWorld) -> SphereWorld:
    """The groove's middle below the place of the sphere."""
    c = world.cell
    return replace(world, cell=replace(c, groove=c.center - [0.5 * 0.3, 0.0, 0.02]))


@dataclass(frozen=True)
class Variation:
    """What is other than in the study's worlds: the cause, its value, the world, the scan of the groove, the measure."""

    cause: str
    value: str
    world: World = _same
    scan: tuple[tuple[str, Any], ...] = ()
    measure: str = "point"


def _tip(share: float) -> World:
    """The tip is believed nearer to where it is; the study's worlds are off by 3.5 mm per axis."""
    return lambda world: replace(world, tip_believed=world.tip + share * (world.tip_believed - world.tip))


_AXES = "mean over the axes"
_NEARER = _tip(0.3)  # of 3.5 mm: 1.1 mm per axis
VARIATIONS = (
    Variation("nothing", "as Table 2 here"),
    Variation("measure", _AXES, measure="axes"),
    Variation("measure", "distance to the trajectory", measure="trajectory"),
    Variation("noise of the sensor", "0.1 mm for 0.05", _errors(noise_m=0.1e-3)),
    Variation("repeatability of the arm", "0", _errors(repeatability_m=0.0)),
    Variation("table and sag of the arm", "exact", _arm),
    Variation("tip", "off by 1.1 mm per axis for 3.5", _NEARER),
    Variation("scale and shear of the sensor", "half", _sensor(0.5, 1.0)),
    Variation("scale, shear and bend of the sensor", "0", _sensor(0.0, 0.0)),
    Variation("path", "below the sphere", _near),
    Variation("depth of the groove", "20 mm for 60", scan=(("depth_m", 0.020),)),
    Variation("distance of the sensor", "165 mm for 195", scan=(("middle_m", 0.165),)),
    Variation("number of profiles", "100 for 25", scan=(("stations", 100),)),
    Variation("tip and depth", "1.1 mm, 20 mm", _NEARER, (("depth_m", 0.020),)),
    Variation("all three", "1.1 mm, 20 mm, to the trajectory", _NEARER, (("depth_m", 0.020),), "trajectory"),
)


@cache
def _seen(world_of: World, scan: tuple[tuple[str, Any], ...], seed: int) -> tuple[float, list[tuple[Floats, Floats]]]:
    """Mean of Table 1 in mm, and of each feature where it is sensed and touched, (n, 3) m, in one world."""
    world = world_of(SphereWorld.like_the_files(seed))
    data = WorldData(sphere_trial(world, seed), scan_groove(world, seed, **dict(scan)))
    groove, features = data.groove, seam_features(data)
    assert groove is not None
    assert features is not None
    record = published_records(data)[SPHERE_METHODS[1]]
    points = measured(0, "", record, data, None, boss=False).points_mm
    pairs = zip(np.swapaxes(features, 0, 1), np.swapaxes(groove.q_touch, 0, 1), strict=True)
    return float(points.mean()), [sensed_and_touched(record, world.cell.arm, groove.q, p, q) for p, q in pairs]


def _error(measure: str, sensed: Floats, touched: Floats) -> float:
    """Mean error mm of points (n, 3) m along a trajectory (n, 3) m that the tip touched."""
    off = sensed - touched
    if measure == "axes":
        return float(np.abs(off).mean() / MM)
    if measure == "trajectory":
        along = np.gradient(touched, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        off = off - np.einsum("ni,ni->n", off, along)[:, None] * along
    return float(np.linalg.norm(off, axis=1).mean() / MM)


def rows(seeds: Sequence[int], progress: Callable[[str, float], None]) -> Iterator[Row]:
    """Return the cells of each variation over these worlds, and last what the paper prints."""
    for k, one in enumerate(VARIATIONS):
        progress(f"Table 2, {one.cause}", k / len(VARIATIONS))
        seen = [_seen(one.world, one.scan, seed) for seed in seeds]
        mean = np.mean([[_error(one.measure, *pair) for pair in pairs] for _, pairs in seen], axis=0)
        points = float(np.mean([at for at, _ in seen]))
        yield (f"{one.cause}: {one.value}", *(fixed(float(v), 3) for v in (*mean, float(mean.mean()), points)))
    _seen.cache_clear()
    printed = (*PRINTED_SEAM, float(np.mean(PRINTED_SEAM)), float(np.mean(PRINTED_POINTS["compensated"])))
    yield ("printed", *(fixed(v, 3) for v in printed))


HEADER = ("varied", *SEAM_FEATURES, "mean", "Table 1, mean")
