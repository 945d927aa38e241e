"""weldcal replay: today's algorithms on a recording, compared with the recorded run."""

from pathlib import Path
from typing import Annotated

import typer

from weldcal.tools.cli.options import LOOK, Call, Outcome, command


@command("replay", common=LOOK, short_help="Repeat a recorded run and compare bit for bit.")
def replay(
    call: Call,
    recording: Annotated[Path, typer.Argument(help="A recording.mcap from --record, or the folder that holds it.")],
) -> Outcome:
    """Run today's algorithms on what a recorded cell saw, and compare all that they did, bit for bit.

    The state is "identical", or "differs" with the first value that is another one; then the exit code is 1. A recording that was
    cut off is replayed to its end.
    """
    from weldcal.tools.commands.record import RECORDING
    from weldcal.tools.commands.replay import replay as run_replay
    from weldcal.tools.outcomes.poses import pose_rows

    found = run_replay(recording / RECORDING if recording.is_dir() else recording, call.progress)
    summary = found.summary()
    values = {
        "compared": f"{found.compared} messages of {found.seconds:.1f} s",
        "recorded with": f"weldcal {found.about.get('version')}, seed {found.about.get('seed')}",
        "ended in": found.phase,
    }
    if found.cut_off:
        values["note"] = "the recording was cut off before its run ended"
    first, problem = found.first, ""
    if first is not None:
        values["first difference"] = f"{first.name} at {first.time_s:.3f} s (message {first.message})"
        values["recorded, replayed"] = f"{first.was}, {first.now}"
        values["ports that differ"] = ", ".join(sorted(found.differences))
        problem = f"The replay differs from the recording since {first.time_s:.3f} s, first in {first.name}."
    rows = {} if found.X_BC is None else pose_rows(found.X_BC)
    return Outcome(summary, values=values, rows=rows, problem=problem)
