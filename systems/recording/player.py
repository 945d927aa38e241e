"""Output what a recording holds of a station's ports, each value at the moment of a tick at which it was read."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.recording.port_recorder import BEFORE, PERIOD_S, STAGES, UPDATE_TICKS, UPDATED, tick_of


@dataclass(frozen=True, eq=False)
class Track:
    """The values of one port: at keys (rising) the values that it had from there on.

    The first holds before its key, too.
    """

    keys: Sequence[int]
    values: Sequence[Any]


@dataclass(frozen=True, eq=False)
class Playback:
    """What a station plays back.

    Tracks of its output ports, sizes of its input ports, and looks by question (answers.py).
    """

    tracks: Mapping[str, Track]
    inputs: Mapping[str, int]
    looks: Mapping[int, int]


class PortPlayer(LeafSystem):
    """Plays recorded ports.

    .. pydrake_system::

        name: PortPlayer

    It has an input port for each port that the recorded cell drove, and an output port for each that it read. The
    inputs are not used. The state is the key up to which updates have played the recording.
    """

    def __init__(self, tracks: Mapping[str, Track], inputs: Mapping[str, int]) -> None:
        super().__init__()
        for name, size in inputs.items():
            self.DeclareVectorInputPort(name, size)
        self._state = self.DeclareDiscreteState([-1.0])
        known = {self.time_ticket(), self.all_state_ticket()}  # no output depends on an input
        for name, track in tracks.items():
            first = track.values[0]
            if isinstance(first, np.ndarray) and first.ndim == 1:
                self.DeclareVectorOutputPort(name, first.size, partial(self._vector, track), known)
            elif isinstance(first, RigidTransform):
                self.DeclareAbstractOutputPort(
                    name, lambda: AbstractValue.Make(RigidTransform()), partial(self._value, track), known
                )
            else:
                make = partial(AbstractValue.Make, first)
                self.DeclareAbstractOutputPort(name, make, partial(self._value, track), known)
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD_S * UPDATE_TICKS, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state(self._state).set_value([STAGES * tick_of(context.get_time()) + UPDATED])

    def _newest(self, track: Track, context: Context) -> Any:
        tick = tick_of(context.get_time())
        # between two unrestricted updates their changes have come with the time
        by_time = STAGES * tick + (BEFORE if tick % UPDATE_TICKS == 0 else UPDATED)
        key = max(by_time, int(context.get_discrete_state(self._state).value()[0]))
        return track.values[max(0, bisect_right(track.keys, key) - 1)]

    def _vector(self, track: Track, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._newest(track, context))

    def _value(self, track: Track, context: Context, output: Any) -> None:
        output.set_value(self._newest(track, context))


def add_player(played: Playback, build: StationBuild) -> None:
    """Add a player to a station in place of its devices."""
    player = build.builder.AddNamedSystem("player", PortPlayer(played.tracks, played.inputs))
    build.inputs |= {name: player.GetInputPort(name) for name in played.inputs}
    build.outputs |= {name: player.GetOutputPort(name) for name in played.tracks}
