"""The tablet cell's two devices: a camera on the wrist that takes a picture when asked, and a tablet that feels the pen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults
from pydrake.systems.framework import Context, LeafSystem, State
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from weldcal.systems.drivers.tablet_world import TabletWorld
from weldcal.systems.messages import Message
from weldcal.systems.tablet_scenario import TabletOnTable, WristRig


@dataclass(frozen=True, eq=False)
class WristPicture(Message):
    """One picture: grey (h, w) uint8 and depth (h, w) m with its noise; `sequence` 0 before the first."""

    sequence: int = 0
    capture_time: float = -np.inf
    grey: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 0), dtype=np.uint8))
    depth_m: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))


class WristCamera(LeafSystem):
    """Takes a picture when the trigger grows.

    .. pydrake_system::

        name: WristCamera
        input_ports:
        - trigger
        - color_image
        - depth_image
        output_ports:
        - picture
    """

    def __init__(self, rig: WristRig, seed: int, period_s: float = 0.02) -> None:
        super().__init__()
        self._rig, self._seed = rig, seed
        self._trigger = self.DeclareVectorInputPort("trigger", 1)
        self._color = self.DeclareAbstractInputPort(
            "color_image", AbstractValue.Make(ImageRgba8U(rig.width, rig.height))
        )
        self._depth = self.DeclareAbstractInputPort(
            "depth_image", AbstractValue.Make(ImageDepth32F(rig.width, rig.height))
        )
        self._shown = self.DeclareAbstractState(AbstractValue.Make(WristPicture()))
        self.DeclareAbstractOutputPort(
            "picture",
            lambda: AbstractValue.Make(WristPicture()),
            self._output,
            {self.abstract_state_ticket(self._shown)},
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        shown: WristPicture = context.get_abstract_state(self._shown).get_value()
        wanted = int(self._trigger.Eval(context)[0])
        if wanted <= shown.sequence:
            return
        rng = np.random.default_rng([self._seed, wanted])
        colour = np.asarray(self._color.Eval(context).data[:, :, :3], dtype=float)
        grey = colour @ np.array([0.299, 0.587, 0.114])
        noisy = np.clip(np.round(grey + rng.normal(0.0, self._rig.grey_noise, grey.shape)), 0, 255).astype(np.uint8)
        depth = np.array(self._depth.Eval(context).data[:, :, 0], dtype=float)
        depth = self._rig.depth_scale * depth + rng.normal(0.0, 1e-3 * self._rig.depth_noise_mm, depth.shape)
        depth[~np.isfinite(depth)] = 0.0
        picture = WristPicture(wanted, context.get_time(), noisy, depth)
        state.get_mutable_abstract_state(self._shown).set_value(picture)

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(context.get_abstract_state(self._shown).get_value())


@dataclass(frozen=True, eq=False)
class TabletTouch(Message):
    """One touch as the page writes it: position (2,) px from the first landmark, to a tenth; `sequence` 0 before the first."""

    sequence: int = 0
    time: float = -np.inf
    position_px: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.nan))
    down: bool = False


class TabletDigitizer(LeafSystem):
    """Feels the pen through the glass: a touch begins when the contact force passes its threshold, and counts once.

    .. pydrake_system::

        name: TabletDigitizer
        input_ports:
        - contact_results
        output_ports:
        - touch
    """

    def __init__(
        self, tablet: TabletOnTable, world: TabletWorld, X_BT: RigidTransform, seed: int, period_s: float = 0.004
    ) -> None:
        super().__init__()
        self._tablet, self._X_TB, self._seed = tablet, X_BT.inverse(), seed
        self._pair = {world.glass, world.nib}
        self._contacts = self.DeclareAbstractInputPort("contact_results", AbstractValue.Make(ContactResults()))
        self._touch = self.DeclareAbstractState(AbstractValue.Make(TabletTouch()))
        self.DeclareAbstractOutputPort(
            "touch", lambda: AbstractValue.Make(TabletTouch()), self._output, {self.abstract_state_ticket(self._touch)}
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: TabletTouch = context.get_abstract_state(self._touch).get_value()
        results: ContactResults = self._contacts.Eval(context)
        felt = None
        for k in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(k)
            pair = info.point_pair()
            if {pair.id_A, pair.id_B} == self._pair and np.linalg.norm(
                info.contact_force()
            ) > self._tablet.touch_force_N:
                felt = self._X_TB.multiply(info.contact_point())[:2]
        if felt is None:
            if old.down:
                lifted = TabletTouch(old.sequence, old.time, old.position_px, False)
                state.get_mutable_abstract_state(self._touch).set_value(lifted)
            return
        if old.down:
            return
        rng = np.random.default_rng([self._seed, old.sequence + 1])
        px = 1e3 * self._tablet.px_per_mm * felt + rng.normal(0.0, self._tablet.touch_noise_px, 2)
        touch = TabletTouch(old.sequence + 1, context.get_time(), np.round(px, 1), True)
        state.get_mutable_abstract_state(self._touch).set_value(touch)

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(context.get_abstract_state(self._touch).get_value())
