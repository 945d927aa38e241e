"""A scanner driver as a stranger would ship it in a package of their own: it computes where rays meet a flange and
nothing else."""

from __future__ import annotations

import dataclasses as dc
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import Context, LeafSystem, State

from weldcal.models.flanges import get_flange
from weldcal.models.scanners import ScannerPreset, get_scanner
from weldcal.systems.drivers.config import ScannerConfig
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.messages import Scan

FLANGE = get_flange("iso9409-1-50-4-m6")
NOISE_M = 3e-5  # of a point along its ray


@dc.dataclass
class RayScanner(ScannerConfig):
    """`!RayScanner`: where it stands in the base."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.65, 0.0, 0.95])
    rpy_deg: list[float] = dc.field(default_factory=lambda: [180.0, 0.0, -90.0])

    def scanner(self) -> ScannerPreset:
        """A small picture of the PhoXi's field of view."""
        return get_scanner("phoxi_m", width=824, height=616)


class RaySensor(LeafSystem):
    """One organised cloud of the flange's face a trigger."""

    def __init__(self, X_BC: RigidTransform, preset: ScannerPreset) -> None:
        super().__init__()
        self._X_BC, self._preset = X_BC, preset
        self._trigger = self.DeclareVectorInputPort("trigger", 1)
        self._pose = self.DeclareAbstractInputPort("X_BF", AbstractValue.Make(RigidTransform()))
        self._time = self.DeclareVectorInputPort("sample_time", 1)
        self._shown = self.DeclareAbstractState(AbstractValue.Make(Scan()))
        self.DeclareAbstractOutputPort("scan", lambda: AbstractValue.Make(Scan()), self._output)
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.02, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        wanted = int(self._trigger.Eval(context)[0])
        if wanted > context.get_abstract_state(self._shown).get_value().sequence:
            X_CF = self._X_BC.inverse() @ self._pose.Eval(context)
            points = self._cast(X_CF, np.random.default_rng(wanted))
            scan = Scan(wanted, float(self._time.Eval(context)[0]), points)
            state.get_mutable_abstract_state(self._shown).set_value(scan)

    def _cast(self, X_CF: RigidTransform, rng: np.random.Generator) -> np.ndarray:
        p = self._preset
        u, v = np.meshgrid(np.arange(p.width), np.arange(p.height))
        rays = np.stack([(u - p.cx) / p.fx, (v - p.cy) / p.fy, np.ones_like(u, dtype=float)], axis=-1)
        normal, centre = X_CF.rotation().matrix()[:, 2], X_CF.translation()
        depth = (normal @ centre) / (rays @ normal) + NOISE_M * rng.standard_normal(u.shape)
        points = rays * depth[..., None]
        face = (points - centre) @ X_CF.rotation().matrix()
        radius = np.linalg.norm(face[..., :2], axis=-1)
        seen = (radius > FLANGE.face_inner_radius_m) & (radius < FLANGE.face_outer_radius_m)
        for x, y, hole in FLANGE.openings():
            seen &= np.hypot(face[..., 0] - x, face[..., 1] - y) > hole
        return np.where(seen[..., None], points, np.nan).astype(np.float32)

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(context.get_abstract_state(self._shown).get_value())


def ApplyDriverConfig(config: RayScanner, build: StationBuild) -> RigidTransform:
    """Stand the sensor in the base and let it follow the arm as it is measured."""
    X_BC = RigidTransform(RollPitchYaw(np.deg2rad(config.rpy_deg)), config.xyz_m)
    sensor = build.builder.AddSystem(RaySensor(X_BC, config.scanner()))
    sensor.set_name("ray_scanner")
    for name in ("X_BF", "sample_time"):
        build.builder.Connect(build.outputs[f"arm.{name}"], sensor.GetInputPort(name))
    build.inputs["scanner.trigger"] = sensor.GetInputPort("trigger")
    build.outputs["scanner.scan"] = sensor.GetOutputPort("scan")
    return X_BC
