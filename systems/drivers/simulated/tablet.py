"""Simulated tablet: detects the pen by its contact force and reports the position to a tenth of a pixel."""

import dataclasses as dc
from typing import ClassVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import GeometryId
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.systems.framework import Context, State

from weldcal.systems.drivers.config import DriverConfig
from weldcal.systems.drivers.simulated.world import SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.jobs.tablet.config import TabletConfig, TabletTouch, TabletTruth
from weldcal.systems.leaf_system import LeafSystem

GLASS, NIB = "tablet_glass", "pen_nib"  # names of the two contact geometries


@dc.dataclass
class SimulatedTablet(DriverConfig):
    """`!SimulatedTablet`: deviation of the tablet's true pose from the nominal one, and its touch threshold."""

    FOR: ClassVar[tuple[str, ...]] = ("digitizer",)
    SIMULATED: ClassVar[bool] = True
    placement_translation_mm: float = 4.0  # drawn from the seed
    placement_rotation_deg: float = 1.5
    touch_noise_px: float = 0.3
    touch_force_N: float = 0.02  # contact force above which the pen is detected


class TabletDigitizer(LeafSystem):
    """Detects the pen on the glass: a touch begins when the contact force exceeds its threshold, and counts once.

    .. pydrake_system::

        name: TabletDigitizer
        input_ports:
        - contact_results
        output_ports:
        - touch
    """

    def __init__(
        self,
        config: SimulatedTablet,
        px_per_m: float,
        pair: set[GeometryId],
        X_BT: RigidTransform,
        seed: int,
        period_s: float = 0.004,
    ) -> None:
        super().__init__()
        self._config, self._px_per_m, self._pair = config, px_per_m, pair
        self._X_TB, self._seed = X_BT.inverse(), seed
        self._contacts = self.DeclareAbstractInputPort("contact_results", AbstractValue.Make(ContactResults()))
        self._touch = self.DeclareAbstractState(AbstractValue.Make(TabletTouch()))
        self.DeclareStateOutputPort("touch", self._touch)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: TabletTouch = context.get_abstract_state(self._touch).get_value()
        felt = self._felt(self._contacts.Eval(context))
        if (felt is not None) == old.down:
            return
        if felt is None:
            new = dc.replace(old, down=False)
        else:
            rng = np.random.default_rng([self._seed, old.sequence + 1])
            px = self._px_per_m * felt + rng.normal(0.0, self._config.touch_noise_px, 2)
            new = TabletTouch(old.sequence + 1, context.get_time(), np.round(px, 1), True)
        state.get_mutable_abstract_state(self._touch).set_value(new)

    def _felt(self, results: ContactResults) -> np.ndarray | None:
        """Position on the page (2,) m of a contact above the threshold; None where there is none."""
        for k in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(k)
            surface = info.contact_surface()
            if {surface.id_M(), surface.id_N()} != self._pair:
                continue
            if np.linalg.norm(info.F_Ac_W().translational()) > self._config.touch_force_N:
                return np.asarray(self._X_TB.multiply(surface.centroid())[:2])
        return None


def _geometry(plant: MultibodyPlant, body: str, build: StationBuild, name: str) -> GeometryId:
    """The collision geometry of that name on a body."""
    inspector = build.require(SimulatedWorld).scene_graph.model_inspector()
    found = plant.GetCollisionGeometriesForBody(plant.world_body() if not body else plant.GetBodyByName(body))
    (geometry,) = (g for g in found if inspector.GetName(g).endswith(name))
    return geometry


def ApplyDriverConfig(config: SimulatedTablet, build: StationBuild) -> None:
    """Add the digitizer of the simulated tablet to the station."""
    plant = build.require(SimulatedWorld).plant
    pair = {_geometry(plant, "", build, GLASS), _geometry(plant, "pen", build, NIB)}
    px_per_m, X_BT = 1e3 * build.require(TabletConfig).px_per_mm, build.require(TabletTruth).X_BT
    tablet = build.builder.AddSystem(TabletDigitizer(config, px_per_m, pair, X_BT, int(build.rng.integers(2**31))))
    tablet.set_name("tablet")
    build.builder.Connect(plant.get_contact_results_output_port(), tablet.GetInputPort("contact_results"))
    build.outputs["digitizer.touch"] = tablet.GetOutputPort("touch")
