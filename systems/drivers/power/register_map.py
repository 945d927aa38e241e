"""The register map of a power source: which register holds which value, in which unit, read from a YAML file."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from weldcal.models.documents import as_number, parse_document, shown
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, read_text
from weldcal.systems.drivers.power.modbus_client import LARGEST_REGISTER, MOST_READ, MOST_WRITTEN

SCHEMA = "weldcal power source map"
FOLDER = Path(__file__).resolve().parents[3] / "models" / "power_sources"
SET = ("arc_on", "job", "wire_feed_m_min", "voltage_V", "current_A", "watchdog")
"""Names of registers that are written; the source watches the connection by `watchdog`, a bit that toggles."""
SHOWN = ("arc_established", "current_A", "voltage_V", "ready", "error")
"""Names of registers that are read; `error`: not 0 is an error, `ready`: 0 is one."""
BITS = ("arc_on", "watchdog", "arc_established", "ready")


@dataclass(frozen=True, kw_only=True)
class Register:
    """One value in a register: raw number = (value - offset) / scale.

    Attributes:
        address: as sent, from 0 on.
        bit, width: lowest bit of the value in the register, and number of its bits; None: the whole register.
        scale, offset: value of one raw unit, and value at 0.
        least, most: of the set value, in its unit; what is beyond is refused before the job.
        signed: the raw number is in two's complement.
    """

    address: int
    bit: int | None = None
    width: int = 1
    scale: float = 1.0
    offset: float = 0.0
    least: float = -math.inf
    most: float = math.inf
    signed: bool = False

    @property
    def mask(self) -> int:
        """The bits of the register that hold the value."""
        return LARGEST_REGISTER if self.bit is None else ((1 << self.width) - 1) << self.bit

    @property
    def ends(self) -> tuple[int, int]:
        """Least and largest raw number."""
        if self.bit is not None:
            return 0, (1 << self.width) - 1
        return (-0x8000, 0x7FFF) if self.signed else (0, LARGEST_REGISTER)

    def word(self, value: float) -> int:
        """The register with this value, nearest to what it can hold, and zeros elsewhere."""
        low, high = self.ends
        return min(max(round((value - self.offset) / self.scale), low), high) << (self.bit or 0) & self.mask

    def value(self, word: int) -> float:
        """The value that a register holds, in its unit."""
        raw = (word & self.mask) >> (self.bit or 0)
        if self.signed and raw > 0x7FFF:
            raw -= 0x10000
        return raw * self.scale + self.offset

    def holds(self, value: float) -> bool:
        """Whether the register can hold a set value."""
        low, high = self.ends
        return self.least <= value <= self.most and low <= (value - self.offset) / self.scale <= high


@dataclass(frozen=True, kw_only=True)
class RegisterMap:
    """Registers of a power source.

    Attributes:
        name: of the power source and its interface.
        set: by names of SET; shown: by names of SHOWN.
        fixed: registers with a value that stays, such as a mode, while the job runs.
        input_registers: what is shown is in input registers (function 4), else in holding registers (function 3).
    """

    name: str
    set: Mapping[str, Register]
    shown: Mapping[str, Register]
    fixed: tuple[tuple[Register, float], ...] = ()
    input_registers: bool = False
    blocks: tuple[range, ...] = field(init=False)  # of neighbours that are written; that with arc_on is the last

    def __post_init__(self) -> None:
        written = sorted({r.address for r in (*self.set.values(), *(r for r, _ in self.fixed))})
        blocks: list[range] = []
        for address in written:
            if blocks and blocks[-1].stop == address and len(blocks[-1]) < MOST_WRITTEN:
                blocks[-1] = range(blocks[-1].start, address + 1)
            else:
                blocks.append(range(address, address + 1))
        arc = self.set.get("arc_on")
        object.__setattr__(self, "blocks", tuple(sorted(blocks, key=lambda b: arc is not None and arc.address in b)))

    @property
    def read_block(self) -> range:
        """The registers that are read in one request."""
        places = [r.address for r in self.shown.values()]
        return range(min(places), max(places) + 1)

    def words(self, values: Mapping[str, float]) -> dict[int, int]:
        """The registers to write, by address, for values by names of SET; what is NaN or not named is 0."""
        words = {address: 0 for block in self.blocks for address in block}
        named = [(register, values.get(name, math.nan)) for name, register in self.set.items()]
        for register, value in (*self.fixed, *named):
            if math.isfinite(value):
                words[register.address] |= register.word(value)
        return words

    def values(self, words: Iterable[int]) -> dict[str, float]:
        """The shown values by name, from the words of read_block."""
        found = list(words)
        start = self.read_block.start
        return {name: register.value(found[register.address - start]) for name, register in self.shown.items()}


def load_register_map(name: str) -> RegisterMap:
    """Read a map: the name of one of the package, or a file.

    Raises:
        InputError: one sentence that says what to change.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else FOLDER / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in FOLDER.glob("*.yaml")))
        raise InputError(f"power_source.map: there is no map '{name}'; write a YAML file, or one of {known}.")
    document = parse_document(path.name, read_text(path, LARGEST_DOCUMENT))
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise InputError(f"{path.name} is no register map: write schema: {SCHEMA}.")
    known_keys = ("schema", "name", "note", "input_registers", "set", "shown", "fixed")
    for key in document:
        if key not in known_keys:
            raise InputError(f"{path.name}: the key '{key}' is not known; known are {', '.join(known_keys)}.")
    parts = {}
    for part, names in (("set", SET), ("shown", SHOWN)):
        given = document.get(part) or {}
        if not isinstance(given, dict) or not set(given) <= set(names):
            raise InputError(f"{path.name}: '{part}' holds registers by the names {', '.join(names)}.")
        parts[part] = {key: _register(f"{path.name}: {part}.{key}", value, key) for key, value in given.items()}
    if "arc_established" not in parts["shown"]:
        raise InputError(f"{path.name}: shown.arc_established is missing: the weld waits for the arc.")
    fixed = document.get("fixed") or []
    found = RegisterMap(
        name=str(document.get("name") or path.stem),
        set=parts["set"],
        shown=parts["shown"],
        fixed=tuple(_fixed(f"{path.name}: fixed[{k}]", value) for k, value in enumerate(fixed)),
        input_registers=document.get("input_registers") is True,
    )
    if len(found.read_block) > MOST_READ:
        raise InputError(f"{path.name}: the registers that are shown lie more than {MOST_READ} apart.")
    _check_shared(path.name, found)
    return found


def _register(place: str, given: Any, name: str) -> Register:
    fields = ("address", "bit", "width", "scale", "offset", "least", "most", "signed")
    if not isinstance(given, dict) or not set(given) <= set(fields) or "address" not in given:
        raise InputError(f"{place} must hold address, and may hold {', '.join(fields[1:])}.")
    numbers: dict[str, Any] = {}
    for key, value in given.items():
        number = as_number(value)
        if key != "signed" and not math.isfinite(number):
            raise InputError(f"{place}.{key} must be a number, not {shown(value)}.")
        numbers[key] = value is True if key == "signed" else int(number) if key in fields[:3] else number
    register = Register(**numbers)
    bit, width = register.bit or 0, register.width
    if not 0 <= register.address <= LARGEST_REGISTER or not (bit >= 0 and width > 0 and bit + width <= 16):
        raise InputError(f"{place} needs an address from 0 to {LARGEST_REGISTER} and bits from 0 to 15.")
    if register.scale == 0.0:
        raise InputError(f"{place}.scale must not be 0.")
    if name in BITS and register.bit is None:
        raise InputError(f"{place} is a bit: write its number, 0 to 15.")
    return register


def _fixed(place: str, given: Any) -> tuple[Register, float]:
    if not isinstance(given, dict) or "value" not in given or not math.isfinite(as_number(given["value"])):
        raise InputError(f"{place} must hold address and value, and may hold bit.")
    rest = {key: value for key, value in given.items() if key != "value"}
    return _register(place, rest, ""), as_number(given["value"])


def _check_shared(name: str, found: RegisterMap) -> None:
    """Raise InputError where two values that are written share a register or a bit of it."""
    taken: dict[int, int] = {}
    for register in (*found.set.values(), *(r for r, _ in found.fixed)):
        if taken.get(register.address, 0) & register.mask:
            raise InputError(f"{name}: two values are written to register {register.address}: give each its own.")
        taken[register.address] = taken.get(register.address, 0) | register.mask
