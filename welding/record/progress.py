"""Writes and reads the progress of a weld: which stretches are welded, and where a broken one goes on."""

import json
import math
import time
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from weldcal.models.documents import as_number, parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_TEXT, read_text, write_durable
from weldcal.welding.numerics import Array
from weldcal.welding.seam.restart import Restart

KILLED, POWER = "killed", "cut off: power was lost, or the computer was restarted"
SCHEMA, VERSION = "weldcal weld progress", 2
PROGRESS_NAME, CRATERS_NAME = "progress.json", "craters.jsonl"


class ProgressError(InputError):
    """The progress of a weld that cannot be read, or that has no rest."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A stretch of a seam on which the arc burned without a break.

    Attributes:
        seam, piece, weld_pass: numbers from 0; run: number of the run from 0, by Progress.ends.
        from_m, to_m: along the whole seam.
        done: the seam, or its piece, ends there.
        begun, time: when the arc was lit and went out, ISO 8601.
    """

    seam: int
    piece: int
    run: int
    from_m: float
    to_m: float
    done: bool
    time: str
    weld_pass: int = 0
    begun: str = ""

    def same_arc(self, other: Self) -> bool:
        """Whether the other one has the same beginning in the same run."""
        return all(getattr(self, k) == getattr(other, k) for k in ("seam", "piece", "weld_pass", "run", "from_m"))

    def longer(self, other: Self) -> bool:
        """Whether it is at least as long as the other one."""
        return abs(self.to_m - self.from_m) >= abs(other.to_m - other.from_m)

    def line(self, p_BCrater: Array) -> str:
        """The line of the crater record: this stretch, and the torch (3,) m at its end."""
        return json.dumps([*vars(self).values(), *np.round(p_BCrater, 6).tolist()]) + "\n"


@dataclass(frozen=True, eq=False, kw_only=True)
class Progress:
    """How far a weld has come, over all its runs.

    Attributes:
        scenario, seed, robot: as they were given; robot None: the scenario's.
        scenario_sha256: of the scenario's files beside the progress.
        ends: how each run ended, this one last; empty: it has not, or nobody saw it end.
        stretches: that are welded, in order.
        seam, piece: numbers from 0 of what is welded next, or again from its crater; done: nothing is.
        p_BCrater, p_BBegin, felt, X_BP, sigma_m: see Restart.
    """

    scenario: str
    seed: int
    robot: str | None
    scenario_sha256: str
    ends: tuple[str, ...] = ("",)
    stretches: tuple[Stretch, ...] = ()
    seam: int = 0
    piece: int = 0
    done: bool = False
    p_BCrater: Array | None = None
    p_BBegin: Array | None = None
    felt: Array | None = None
    X_BP: Array | None = None
    sigma_m: float = math.nan

    def restart(self, overlap_m: float) -> Restart:
        """Where the weld goes on."""
        last = self.stretches[-1] if self.stretches and self.p_BCrater is not None else None
        same = {
            name: getattr(self, name) for name in ("seam", "piece", "p_BCrater", "p_BBegin", "felt", "X_BP", "sigma_m")
        }
        return Restart(**same, overlap_m=overlap_m, crater_m=math.nan if last is None else last.to_m)

    def settled(self) -> Self:
        """The progress with the end of a last run that nobody saw: whether its computer was started again after it."""
        if self.ends[-1]:
            return self
        boot = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else 0.0
        last = max((datetime.fromisoformat(one.time).timestamp() for one in self.stretches), default=math.inf)
        return replace(self, ends=(*self.ends[:-1], POWER if last < boot else KILLED))

    def with_stretch(self, stretch: Stretch) -> Self:
        """The progress with a new stretch, or with a newer end of the last one."""
        kept = self.stretches
        last = kept[-1] if kept else None
        same = last is not None and not last.done and last.same_arc(stretch)
        return replace(self, stretches=(*(kept[:-1] if same else kept), stretch))

    def with_crater(self, line: bytes) -> Self:
        """The progress with a line of the crater record, where it is farther on the seam whose turn it is."""
        try:
            *values, x, y, z = json.loads(line)
            stretch = Stretch(**dict(zip(Stretch.__annotations__, values, strict=True)))
            p_BCrater = np.array((x, y, z), dtype=float)
        except (TypeError, ValueError):
            return self
        last, here = self.stretches[-1] if self.stretches else None, (self.seam, self.piece, len(self.ends) - 1)
        old = last is not None and last.same_arc(stretch) and (last.done or last.longer(stretch))
        if self.done or old or (stretch.seam, stretch.piece, stretch.run) != here:
            return self
        return replace(self.with_stretch(stretch), p_BCrater=p_BCrater)

    def write(self, folder: Path) -> None:
        """Write progress.json, so that it survives a loss of power."""
        document: dict[str, Any] = {"schema": SCHEMA, "version": VERSION}
        document |= {k: v for k, v in vars(self).items() if k not in (*_ARRAYS, "stretches", "sigma_m")}
        document["sigma_mm"] = 1e3 * self.sigma_m if math.isfinite(self.sigma_m) else None
        document["stretches"] = [vars(stretch) for stretch in self.stretches]
        for name in _ARRAYS:
            value = getattr(self, name)
            document[name] = None if value is None else np.round(value, 9).tolist()
        write_durable(folder / PROGRESS_NAME, json.dumps(document, allow_nan=False) + "\n")


_LAST_LINES = 20  # a choice: a loss of power may damage the last ones
_ARRAYS = {"p_BCrater": (3,), "p_BBegin": (3,), "felt": (-1, 4), "X_BP": (4, 4)}


def load_progress(folder: Path) -> Progress:
    """Read the progress of a weld from its result folder.

    Raises:
        ProgressError: one sentence that says what is missing or damaged.
    """
    path = folder / PROGRESS_NAME
    if not path.is_file():
        raise ProgressError(
            f"'{folder}' holds no broken weld ({PROGRESS_NAME} is missing): give the result folder of the weld."
        )
    document = parse_document(path.name, read_text(path, LARGEST_TEXT), "JSON")
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise ProgressError(f"{path} is not the progress of a weld: its schema is not '{SCHEMA}'.")
    if document.get("version") != VERSION:
        raise ProgressError(f"{path} has version {document.get('version')}; this weldcal reads version {VERSION}.")
    try:
        arrays: dict[str, Any] = {name: _array(document[name], shape) for name, shape in _ARRAYS.items()}
        sigma = document["sigma_mm"]
        found = Progress(
            scenario=str(document["scenario"]),
            scenario_sha256=str(document["scenario_sha256"]),
            seed=int(document["seed"]),
            seam=int(document["seam"]),
            piece=int(document["piece"]),
            robot=None if document["robot"] is None else str(document["robot"]),
            ends=tuple(map(str, document["ends"])),
            stretches=tuple(Stretch(**row) for row in document["stretches"]),
            done=bool(document["done"]),
            sigma_m=math.nan if sigma is None else 1e-3 * as_number(sigma),
            **arrays,
        )
        craters = folder / CRATERS_NAME
        lines = craters.read_bytes().split(b"\n")[:-1] if craters.is_file() else []
        for line in lines[-_LAST_LINES:]:
            found = found.with_crater(line)
        return found
    except (KeyError, TypeError, ValueError) as problem:
        raise ProgressError(f"{path} is damaged ({problem}): weld the rest by hand.") from None


def _array(value: Any, shape: tuple[int, ...]) -> Array | None:
    return None if value is None else np.array(value, dtype=float).reshape(shape)
