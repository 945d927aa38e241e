"""Benchmark of the hardware link under faults: a matrix of faults, and random sequences of them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated

from tests.figures.robot.stream import TRANSPORT, jobs, one_transport, stream
from tests.figures.robot.wired import soak, wired_faults
from tests.figures.subject import one_of
from tests.worlds.robot.bench import Bench
from tests.worlds.robot.cases import AT_START, RUNNING
from tests.worlds.robot.fault_run import FaultOutcome, FaultSequence, run_case, run_sequence
from weldcal.systems.drivers.ur.wire.transport import NATIVE
from weldcal.systems.pacing import no_long_garbage_collections
from weldcal.tools.cli.options import FARM, Call, command, option
from weldcal.tools.cli.options import Outcome as Printed
from weldcal.tools.emulators.ur.process import emulator_process
from weldcal.tools.report.render import csv_text, statistics, write_atomic, write_json


@dataclass(frozen=True)
class FaultReport:
    """All outcomes and all sequences."""

    outcomes: list[FaultOutcome]
    sequences: list[FaultSequence]

    def summary(self) -> dict[str, object]:
        """Return the JSON object: ms, and mm of the tool, from the fault on; `wrong` names unmet requirements."""
        stopped = [outcome for outcome in self.outcomes if outcome.did == "stopped"]
        wrong = [{"id": o.name, "reason": "; ".join(o.problems)} for o in self.outcomes if not o.ok]
        wrong += [{"id": f"sequence {s.seed}", "reason": s.verdict} for s in self.sequences if not s.ok]
        return {
            "state": "failed" if wrong else "done",
            "reason": f"{len(wrong)} faults or sequences had a wrong result; see `wrong`." if wrong else None,
            "faults": len(self.outcomes),
            "stopped": len(stopped),
            "went_on": sum(outcome.did == "went on" for outcome in self.outcomes),
            "refused": sum(outcome.did == "refused" for outcome in self.outcomes),
            "rest_after_ms": _spread([o.rest_after_ms for o in stopped]),
            "travel_mm": _spread([o.travel_mm for o in stopped]),
            "unasked_stops": sum(o.retries for o in self.outcomes) + sum(s.unasked_stops for s in self.sequences),
            "sequences": len(self.sequences),
            "sequence_seconds": sum(s.seconds for s in self.sequences),
            "sequence_faults": sum(s.thrown.total() for s in self.sequences),
            "sequence_starts": sum(s.starts for s in self.sequences),
            "moves_without_a_command": sum(s.moves_without_a_command for s in self.sequences),
            "moves_after_a_fault": sum(s.moves_after_a_fault for s in self.sequences),
            "unattended_s": sum(s.unattended_s for s in self.sequences),
            "wrong": wrong,
        }


def _spread(values: Sequence[float | None]) -> dict[str, float]:
    found = [value for value in values if value is not None]
    return statistics(found, "median", "max") if found else {}


def _table(kind: type[FaultOutcome] | type[FaultSequence], rows: Sequence[object]) -> str:
    columns = [field.name for field in fields(kind)]
    return csv_text(columns, ([_cell(getattr(row, name)) for name in columns] for row in rows))


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.2f}"
    if isinstance(value, Counter):
        return "; ".join(f"{name} {count}" for name, count in sorted(value.items()))
    if isinstance(value, tuple | list):
        return "; ".join(map(str, value))
    return "" if value is None else str(value)


@command(
    "benchmark robot-faults",
    short_help="Inject every fault of the robot link while moving.",
    hidden=True,
    options=("address",),
)
def faults(
    call: Call,
    sequences: Annotated[int, option("--sequences", "N", "Number of random fault sequences.", min=0)] = 20,
    seconds: Annotated[float, option("--seconds", "S", "Length of each.", min=1.0)] = 60.0,
    transport: Annotated[str, TRANSPORT] = NATIVE,
) -> Printed:
    """Inject every fault of the robot link at 0.05 m/s on an emulated controller: the arm must stop, stay, and say
    why."""
    out, address, seed = call.folder("benchmark", "robot-faults"), call.given["address"], call.seed
    transport = one_transport(transport)
    report, cases = FaultReport([], []), RUNNING + AT_START
    share = 150.0 / (150.0 + sequences * seconds)
    with emulator_process(host=address, seed=seed) as emulator, no_long_garbage_collections():
        bench = Bench(emulator, transport=transport)
        for k, case in enumerate(cases):  # each must be able to start after the one before
            call.progress(case.name, share * k / len(cases))
            report.outcomes.append(run_case(bench, case, hasty=False))
            write_atomic(out / "faults.csv", _table(FaultOutcome, report.outcomes))
    for k in range(sequences):
        call.progress(f"sequence {k + 1} of {sequences}", share + (1.0 - share) * k / sequences)
        with emulator_process(host=address, seed=seed + k) as emulator, no_long_garbage_collections():
            report.sequences.append(run_sequence(Bench(emulator, transport=transport), seed + k, seconds))
        write_atomic(out / "sequences.csv", _table(FaultSequence, report.sequences))
    write_json(out / "robot_faults.json", report.summary())
    return Printed(report.summary(), rows={outcome.name: outcome.line for outcome in report.outcomes})


@command("benchmark robot", short_help="Measure the robot link and the cell by wire.", options=("address", *FARM))
@one_of("stream", stream=stream, faults=faults, jobs=jobs, wired_faults=wired_faults, soak=soak)
def robot(call: Call) -> None:
    """Measure the robot link and the cell by wire: periods of commands, faults, lateness in whole jobs, and long
    runs."""
