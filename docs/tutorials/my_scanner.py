"""Drive a scanner: its configuration, a system that scans, and what adds the system."""

import dataclasses as dc
from typing import Any, cast

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from simulated_scans import pose, scan

from weldcal.models.scanners import ScannerPreset, get_scanner
from weldcal.systems import LeafSystem, Scan, ScannerConfig, StationBuild


@dc.dataclass
class MyScanner(ScannerConfig):
    """`!MyScanner {}`: a scanner that looks down from xyz_m in the robot's base."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.65, 0.0, 0.95])

    def scanner(self) -> ScannerPreset:
        """Return intrinsics, range and noise; weldcal plans the poses with them."""
        return get_scanner("phoxi_m", width=824, height=616)


class MySensor(LeafSystem):
    """Take one scan each time `trigger` increases."""

    def __init__(self, X_BC: RigidTransform) -> None:
        super().__init__()
        self._X_BC: Any = X_BC
        self._trigger: Any = self.DeclareVectorInputPort("trigger", 1)
        self._time: Any = self.DeclareVectorInputPort("sample_time", 1)
        # Drake's stubs do not type what an abstract port carries, hence `cast`.
        pose_type: Any = cast(Any, AbstractValue).Make(RigidTransform())
        self._X_BF: Any = self.DeclareAbstractInputPort("X_BF", pose_type)
        self._newest = self.DeclareAbstractState(cast(Any, AbstractValue).Make(Scan()))
        self.DeclareStateOutputPort("scan", self._newest)
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.02, 0.0, self._update)

    def _update(self, context: Any, state: Any) -> None:
        number = int(self._trigger.Eval(context)[0])
        if number > context.get_abstract_state(self._newest).get_value().sequence:
            X_CF = self._X_BC.inverse() @ self._X_BF.Eval(context)
            points_C = scan(X_CF, np.random.default_rng(number))  # ask your device here
            time = float(self._time.Eval(context)[0])
            newest = Scan(number, time, points_C.astype(np.float32))
            state.get_mutable_abstract_state(self._newest).set_value(newest)


def ApplyDriverConfig(config: MyScanner, build: StationBuild) -> RigidTransform:
    """Add the sensor, connect it, and name its ports; return X_BC where it is known."""
    X_BC = pose(np.pi, 0.0, -np.pi / 2, config.xyz_m)
    sensor = build.builder.AddNamedSystem("my_scanner", MySensor(X_BC))
    for name in ("X_BF", "sample_time"):
        build.builder.Connect(build.outputs[f"arm.{name}"], sensor.GetInputPort(name))
    build.inputs["scanner.trigger"] = sensor.GetInputPort("trigger")
    build.outputs["scanner.scan"] = sensor.GetOutputPort("scan")
    return X_BC
