"""Opens the recording of a run: what the file says of it, the scenario with its files, and the sink for the cell's ports."""

from __future__ import annotations

import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Final

from weldcal.systems.recording.port_recorder import ENTERED, LEFT
from weldcal.systems.recording.scenario_files import packed
from weldcal.systems.recording.tap import Layout, OpenSink
from weldcal.systems.recording.values import encode
from weldcal.systems.recording.writer import RecordingWriter
from weldcal.systems.runner import Run
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.tools.report.run import RunOptions

RECORDING: Final = "recording.mcap"
_PACKAGES = ("drake", "numpy", "scipy", "open3d", "opencv-python-headless", "numba")


class RunRecorder:
    """Records one run, from the building of its cell to its end."""

    def __init__(self, scenario: Scenario, options: RunOptions, robot: str) -> None:
        self._scenario, self._options, self._robot = scenario, options, robot
        self._writer: RecordingWriter | None = None

    @property
    def open_sink(self) -> OpenSink:
        """See build_cell."""
        return self._open

    def _open(self, station: Station, layout: Layout) -> RecordingWriter:
        sizes = {ENTERED: layout.entered, LEFT: layout.left}
        about = {
            "sizes": json.dumps(sizes),
            "version": version("weldcal"),
            "packages": json.dumps({name: version(name) for name in _PACKAGES}),
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.machine()}",
            "scenario": self._options.scenario,
            "seed": str(self._options.seed),
            "robot": self._robot,
            "drives": json.dumps(layout.drives),
            "arm": json.dumps(encode(station.arm)),
            "q_start": json.dumps(encode(station.q_start)),
        }
        self._options.out.mkdir(parents=True, exist_ok=True)
        self._writer = RecordingWriter(self.path, about, packed(self._scenario), station.arm, sizes)
        return self._writer

    @property
    def path(self) -> Path:
        """The file."""
        return self._options.out / RECORDING

    def close(self, run: Run | None) -> None:  # type: ignore[type-arg]  # of any job
        """End the file; without a run (it has failed) it stays as one that was cut off.

        Raises:
            RecordingFailed: see RecordingWriter.close.
        """
        if self._writer is not None and run is not None:
            self._writer.close({"time": run.seconds, "phase": run.command.phase, "interrupted": run.interrupted})
