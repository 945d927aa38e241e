"""The tablet job: the camera takes one picture of the tablet, then the pen touches each of its landmarks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.drivers.simulated.furnishing import Furnishing
from weldcal.systems.drivers.simulated.rendered_wrist_camera import RenderedWristCamera
from weldcal.systems.drivers.simulated.tablet_world import tablet_fittings
from weldcal.systems.jobs.job import AddedJob, Job, Phases
from weldcal.systems.jobs.tablet.config import TabletConfig, check_tablet
from weldcal.systems.jobs.tablet.messages import TabletTruth, WristPicture
from weldcal.systems.jobs.tablet.planning import camera_of, check_moves, plan_tablet, tablet_of
from weldcal.systems.jobs.tablet.procedure import TabletPlan, TabletProcedure, TabletState
from weldcal.systems.motion.spine import JobPorts, Spine
from weldcal.systems.phase_words import phase_words
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring


@dataclass(eq=False, kw_only=True)
class AddedVisit(AddedJob):
    """The systems of the job, the nominal tablet and camera; `known` is the ground truth of a simulation."""

    plan: TabletPlan
    tablet: TabletConfig
    camera: RenderedWristCamera
    procedure: TabletProcedure
    station: Station
    known: TabletTruth | None
    ports: JobPorts
    maximum_time_s: float

    @property
    def truth(self) -> TabletTruth:
        """For reports and tests; raises RuntimeError in a cell that is not simulated."""
        if self.known is None:
            raise RuntimeError("only a simulated tablet has a known true pose")
        return self.known

    def picture(self, root: Context) -> WristPicture:
        """The camera's newest picture."""
        diagram = self.station.diagram
        shown: WristPicture = diagram.GetOutputPort("wrist_camera.picture").Eval(diagram.GetMyContextFromRoot(root))
        return shown

    def view(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See AddedJob: in front of the tablet."""
        middle = self.tablet.pose().multiply(np.r_[0.5 * self.tablet.landmarks_m().max(axis=0), 0.0])
        return middle + np.array([0.55, -0.35, 0.45]), middle + np.array([0.0, 0.0, 0.08])

    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """See AddedJob: the picture is a tenth of the run, the touches are nearly all of the rest."""
        state: TabletState = self.state(root)
        touching = state.phase in ("to_above", "descend", "lift")
        text = phase_words(state.phase, f"{state.landmark + 1} of {len(self.plan.q_above)}" if touching else "")
        touched = 0.80 * len(state.touches) / len(self.plan.q_above)
        return text, 0.95 if state.finished else 0.05 + 0.05 * (state.trigger > 0) + touched


class Tablet(Job[TabletPlan]):
    """The job of a scenario with a `tablet` part."""

    key = "tablet"
    config = TabletConfig

    def check(self, scenario: Scenario) -> None:
        """See Job."""
        check_tablet(scenario)

    def furnish(
        self, scenario: Scenario, rng: np.random.Generator, part: WeldPart | None, X_BP: RigidTransform | None
    ) -> Furnishing:
        """See Job: camera, pen and tablet at their true poses."""
        visit = tablet_fittings(tablet_of(scenario), scenario.wrist_camera, scenario.digitizer, rng)
        return Furnishing(fittings=(visit,), parts=(visit.tablet, visit.truth), contacts_read=True)

    def plan(self, scenario: Scenario, station: Station, seed: int) -> TabletPlan:
        """See Job."""
        plan = plan_tablet(scenario, station.arm)
        check_moves(scenario, station, plan)
        return plan

    def add(self, wiring: Wiring, spine: Spine, plan: TabletPlan) -> AddedVisit:
        """See Job."""
        station, scenario = wiring.station, wiring.scenario
        procedure = wiring.add("tablet_procedure", TabletProcedure(station.arm, plan))
        wiring.connect(
            procedure,
            position_measured=spine.arm.position,
            settled_goal=spine.arm.settled_goal,
            robot_status=spine.arm.status,
            history=spine.arm.history,
            picture=wiring.out("wrist_camera.picture"),
            touch=wiring.out("digitizer.touch"),
            hold=spine.end,
        )
        wiring.feed("wrist_camera.trigger", procedure.GetOutputPort("trigger"))
        ports = JobPorts(
            commands=(procedure.GetOutputPort("job"),),
            state=procedure.GetOutputPort("state"),
            velocity=procedure.GetOutputPort("descent"),
            shown={"picture": wiring.out("wrist_camera.picture")},
        )
        return AddedVisit(
            plan=plan,
            tablet=tablet_of(scenario),
            camera=camera_of(scenario),
            procedure=procedure,
            station=station,
            known=station.truth.tablet,
            ports=ports,
            maximum_time_s=plan.maximum_time_s,
        )


JOB = Tablet()
