"""The hardware link under faults: a matrix of faults, and random sequences of them."""

from collections.abc import Sequence

from tests.figures.harness import Missed, Run, figure
from tests.worlds.robot.bench import Bench
from tests.worlds.robot.cases import AT_START, RUNNING
from tests.worlds.robot.fault_run import FaultOutcome, FaultSequence, run_case, run_sequence
from weldcal.calibration.data.results import statistics
from weldcal.systems.pacing import no_long_garbage_collections
from weldcal.tools.emulators.ur.process import emulator_process


def wrong_ones(outcomes: Sequence[FaultOutcome], sequences: Sequence[FaultSequence]) -> dict[str, str]:
    """Return the reason of each fault or sequence with a wrong result."""
    wrong = {o.name: "; ".join(o.problems) for o in outcomes if not o.ok}
    return wrong | {f"sequence {s.seed}": s.verdict for s in sequences if not s.ok}


@figure("robot-faults", "every fault of the robot link at 0.05 m/s on an emulated controller, and random sequences")
def faults(run: Run) -> None:
    """Inject each fault: the arm must stop, stay, and say why. 25 minutes in full."""
    outcomes, sequences, cases = [], [], [c for c in RUNNING + AT_START if run.full or c.short]
    with emulator_process(seed=run.seed) as emulator, no_long_garbage_collections():
        bench = Bench(emulator)
        for k, case in enumerate(cases):  # each must be able to start after the one before
            run.progress(case.name, k / len(cases))
            outcomes.append(run_case(bench, case, hasty=False))
    for seed in run.seeds(0, 10):
        run.progress(f"sequence {seed}", 1.0)
        with emulator_process(seed=seed) as emulator, no_long_garbage_collections():
            sequences.append(run_sequence(Bench(emulator), seed, 60.0))
    run.table("", ("fault", "result"), ((o.name, o.line) for o in outcomes))
    stopped = [o for o in outcomes if o.did == "stopped"]
    rest, travel = (
        statistics([v for o in stopped if (v := getattr(o, key)) is not None], "median", "max")
        for key in ("rest_after_ms", "travel_mm")
    )
    did = ", ".join(f"{sum(o.did == what for o in outcomes)} {what}" for what in ("stopped", "went on", "refused"))
    wrong = wrong_ones(outcomes, sequences)
    rows = (
        ("faults", f"{len(outcomes)}: {did}"),
        ("at rest after, ms: median, most", f"{rest['median']:.0f}, {rest['max']:.0f}"),
        ("travel, mm: median, most", f"{travel['median']:.2f}, {travel['max']:.2f}"),
        ("random faults", str(sum(s.thrown.total() for s in sequences))),
        ("moves without a command", str(sum(s.moves_without_a_command for s in sequences))),
        ("moves after a fault", str(sum(s.moves_after_a_fault for s in sequences))),
        ("wrong", "; ".join(f"{name}: {why}" for name, why in wrong.items()) or "none"),
    )
    run.table("", ("", "found"), rows)
    if wrong:
        raise Missed(f"{len(wrong)} faults or sequences had a wrong result; see the table.")
