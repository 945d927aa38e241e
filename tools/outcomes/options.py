"""What a person may choose for a run of a cell."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RunOptions:
    """What a person may choose: scenario by name or path, result folder, seed, whether to open a browser, real time or as fast
    as it goes; the robot (see chosen_robot; None: the scenario's), and how fast the arm's moves are (None: the scenario's)."""

    scenario: str
    out: Path
    seed: int = 0
    browser: bool = False
    realtime: bool = False
    robot: str | None = None
    dry_run: bool = False
    pace: float | None = None
    speed_factor: float | None = None
    recording: bool = True
