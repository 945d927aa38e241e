"""weldcal benchmark: the cell by wire, with its world in another process."""

from typing import Annotated

from weldcal.tools.cli.options import FARM, Call, Outcome, command, option


@command("benchmark soak", short_help="Calibrate and weld by wire for an hour with faults.")
def soak(
    call: Call,
    minutes: Annotated[float, option("--minutes", "M", "How long new cycles begin.", min=0.1)] = 60.0,
) -> Outcome:
    """Calibrate and weld by wire again and again with random faults: memory, stuck processes, faults by name, motion and arc."""
    from weldcal.tools.studies.wired.soak import run_soak

    summary, table = run_soak(call.folder("benchmark", "soak"), minutes, call.seed, call.progress)
    return Outcome(summary, text=table)


@command("benchmark wired-faults", short_help="Disturb each device by wire in each phase of the job.", options=FARM)
def wired_faults(
    call: Call,
    devices: Annotated[list[str] | None, option("--device", "NAME", "Only this device; repeat for more.")] = None,
    phases: Annotated[list[str] | None, option("--phase", "NAME", "Only this phase; repeat for more.")] = None,
) -> Outcome:
    """Kill, freeze and delay each device by wire, and let it send garbage, in each phase: the arm must stand, and the job say why."""
    from weldcal.tools.studies.wired.faults import run_wired_faults

    farm = call.farm(call.folder("benchmark", "wired-faults"))
    summary, table = run_wired_faults(farm, call.seed, devices or (), phases or ())
    return Outcome(summary, text=table)
