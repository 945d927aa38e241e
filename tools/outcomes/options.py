"""The options of a run of a cell."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """The user's options: scenario by name or path, result folder, seed, whether to open a browser, real time or as fast as
    possible; the robot (see chosen_robot; None: the scenario's), and the speed of the arm's moves (None: the scenario's).
    `share`: the dashboard is also shown to the network,
    read-only. `recording`: the viewer's recording.html; `record`: recording.mcap, which `weldcal replay` plays back."""

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
    share: bool = False
    record: bool = False
