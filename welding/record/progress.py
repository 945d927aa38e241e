"""Writes and reads the progress of a weld: which stretches are welded, and where a broken one goes on."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from weldcal.models.documents import as_number, parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_TEXT, read_text, write_durable
from weldcal.welding.numerics import Array
from weldcal.welding.seam.restart import Restart

SCHEMA, VERSION = "weldcal weld progress", 1
PROGRESS_NAME, CRATERS_NAME = "progress.json", "craters.jsonl"


class ProgressError(InputError):
    """The progress of a weld that cannot be read, or that has no rest."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A stretch of a seam on which the arc burned without a break.

    Attributes:
        seam, piece: numbers from 0; run: number of the run from 0, by Progress.folders.
        from_m, to_m: along the whole seam.
        done: the seam, or its piece, ends there.
        time: when the arc went out, ISO 8601.
    """

    seam: int
    piece: int
    run: int
    from_m: float
    to_m: float
    done: bool
    time: str

    def same_arc(self, other: Self) -> bool:
        """Whether the other one has the same beginning in the same run."""
        return all(getattr(self, k) == getattr(other, k) for k in ("seam", "piece", "run", "from_m"))

    def line(self, p_BCrater: Array) -> str:
        """The line of the crater record: this stretch, and the torch (3,) m at its end."""
        return json.dumps([*vars(self).values(), *np.round(p_BCrater, 6).tolist()]) + "\n"


@dataclass(frozen=True, eq=False, kw_only=True)
class Progress:
    """How far a weld has come, over all its runs.

    Attributes:
        scenario, seed, robot: as they were given; robot None: the scenario's.
        scenario_sha256: of the scenario's files beside the progress.
        folders: results of the runs, this one last; continued_in: that of the run that went on from here.
        stretches: that are welded, in order.
        seam, piece: numbers from 0 of what is welded next, or again from its crater; done: nothing is.
        p_BCrater, p_BBegin, felt, X_BP, sigma_m: see Restart.
        X_BC: (4, 4), pose of the scanner; None: not known.
    """

    scenario: str
    seed: int
    robot: str | None
    scenario_sha256: str
    folders: tuple[str, ...]
    continued_in: str = ""
    stretches: tuple[Stretch, ...] = ()
    seam: int = 0
    piece: int = 0
    done: bool = False
    p_BCrater: Array | None = None
    p_BBegin: Array | None = None
    felt: Array | None = None
    X_BP: Array | None = None
    sigma_m: float = math.nan
    X_BC: Array | None = None

    def restart(self, overlap_m: float) -> Restart:
        """Where the weld goes on."""
        return Restart(
            seam=self.seam,
            piece=self.piece,
            p_BCrater=self.p_BCrater,
            p_BBegin=self.p_BBegin,
            felt=self.felt,
            X_BP=self.X_BP,
            sigma_m=self.sigma_m,
            overlap_m=overlap_m,
        )

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
        last, here = self.stretches[-1] if self.stretches else None, (self.seam, self.piece, len(self.folders) - 1)
        old = last is not None and last.same_arc(stretch) and (last.done or last.to_m >= stretch.to_m)
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
_ARRAYS = {"p_BCrater": (3,), "p_BBegin": (3,), "felt": (-1, 4), "X_BP": (4, 4), "X_BC": (4, 4)}


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
            continued_in=str(document["continued_in"]),
            seed=int(document["seed"]),
            seam=int(document["seam"]),
            piece=int(document["piece"]),
            robot=None if document["robot"] is None else str(document["robot"]),
            folders=tuple(map(str, document["folders"])),
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
