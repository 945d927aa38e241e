"""The order of a weld: procedure, part, operator, materials, and the limits that its record is compared with."""

import math
from dataclasses import asdict, dataclass, field, fields

from weldcal.models.errors import InputError


class WeldOrderError(InputError):
    """An order with invalid values."""


LONGEST_TEXT = 200  # a choice: a cell of a table; a longer text is a file that was pasted into the wrong key
RANGES = ("heat_input_kJ_mm", "speed_mm_s", "current_A", "voltage_V")
"""Limits that are a range; each is also a figure of a welded seam."""


@dataclass(kw_only=True)
class OrderLimits:
    """The limits of the procedure, each compared with the least and the largest value of a 10 mm stretch of seam."""

    heat_input_kJ_mm: list[float] | None = None  # least and largest; null: no limit
    speed_mm_s: list[float] | None = None  # least and largest travel speed
    current_A: list[float] | None = None  # least and largest
    voltage_V: list[float] | None = None  # least and largest
    path_mm: float | None = None  # largest distance of the torch from the felt seam

    def check(self) -> None:
        """Raise WeldOrderError for a range that is none, or a distance that is not positive."""
        for name in RANGES:
            value = getattr(self, name)
            if value is None:
                continue
            if len(value) != 2 or not all(map(math.isfinite, value)) or not 0.0 <= value[0] < value[1]:
                raise WeldOrderError(
                    f"welding.order.limits.{name} must hold the least and the largest value, such as [1.0, 2.0], not"
                    f" {value}."
                )
        if self.path_mm is not None and not (math.isfinite(self.path_mm) and self.path_mm > 0.0):
            raise WeldOrderError(f"welding.order.limits.path_mm must be a positive number, not {self.path_mm:g}.")


@dataclass(kw_only=True)
class WeldOrder:
    """What the weld is ordered as, for its record; every key but `limits` is a free text, and may be empty."""

    order: str = ""  # number of the work order
    wps: str = ""  # welding procedure specification and its revision
    wpqr: str = ""  # record of the procedure's qualification
    drawing: str = ""  # of the part, with its revision
    part: str = ""  # part number
    serial: str = ""  # serial number of this part
    batch: str = ""
    operator: str = ""  # name or identification
    material: str = ""  # parent material, with its heat number
    filler: str = ""  # designation and diameter
    filler_batch: str = ""
    gas: str = ""  # shielding gas
    position: str = ""  # welding position, such as PA (ISO 6947)
    note: str = ""
    limits: OrderLimits = field(default_factory=OrderLimits)

    @property
    def texts(self) -> dict[str, str]:
        """The texts by key, empty ones included."""
        return {f.name: str(getattr(self, f.name)) for f in fields(self) if f.name != "limits"}

    @property
    def empty(self) -> bool:
        """Whether nothing was ordered."""
        return self == WeldOrder()

    def check(self) -> None:
        """Raise WeldOrderError for a text that is no cell of a table, or for an invalid limit."""
        for name, text in self.texts.items():
            if len(text) > LONGEST_TEXT or not text.isprintable():
                raise WeldOrderError(
                    f"welding.order.{name} must be one line of at most {LONGEST_TEXT} characters; it has {len(text)}."
                )
        self.limits.check()

    def document(self) -> dict[str, object]:
        """The order in JSON's own types: the texts that are given, and the limits that are given."""
        given: dict[str, object] = {name: text for name, text in self.texts.items() if text}
        limits = {name: value for name, value in asdict(self.limits).items() if value is not None}
        return given | ({"limits": limits} if limits else {})
