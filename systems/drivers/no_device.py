"""The absence of a device, said in the scenario with a word."""

import dataclasses as dc


@dc.dataclass
class NoDevice:
    """`!NoDevice {}`: this cell has no such device."""
