"""Reads the power source's digital inputs: arc established and arc fault."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ArcInputs:
    """Standard digital inputs of the power source: arc established, arc fault; None where one is not wired."""

    established: int | None = None
    arc_fault: int | None = None

    @property
    def wired(self) -> bool:
        """Whether there is one."""
        return self.established is not None or self.arc_fault is not None

    def arc(self, bits: int) -> bool | None:
        """Whether the arc is established; None where that is not wired."""
        return None if self.established is None else bool(bits >> self.established & 1)

    def fault(self, bits: int) -> bool:
        """Whether the power source reports a fault."""
        return self.arc_fault is not None and bool(bits >> self.arc_fault & 1)
