"""FrameReplay: outputs frames that were rendered beforehand at a scanner's rate, with the joints of the arm that they
show."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context

from weldcal.models.arrays import Array
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import ScanStream, StreamedScan

_SHOWN = 4  # newest frames on the port


class FrameReplay(LeafSystem):
    """Outputs clouds in turn, again and again.

    .. pydrake_system::

        name: FrameReplay
        output_ports:
        - stream
        - joints
        - time

    A frame arrives ``delay_s`` after its capture. ``joints`` gives the arm's (6,) rad at a time (s) from the first
    cloud on.
    """

    def __init__(
        self, clouds: Sequence[NDArray[np.float32]], joints: Callable[[float], Array], rate_hz: float, delay_s: float
    ) -> None:
        super().__init__()
        self._clouds, self._motion, self._rate_hz, self._delay_s = clouds, joints, rate_hz, delay_s
        self.DeclareAbstractOutputPort("stream", lambda: AbstractValue.Make(ScanStream()), self._stream)
        self.DeclareVectorOutputPort("joints", 6, self._joints)
        self.DeclareVectorOutputPort("time", 1, self._time)

    def _stream(self, context: Context, output: Any) -> None:
        newest = int((context.get_time() - self._delay_s) * self._rate_hz + 1e-9)
        frames = []
        for n in range(max(1, newest - _SHOWN + 1), newest + 1):
            capture, points = n / self._rate_hz, self._clouds[n % len(self._clouds)]
            frames.append(StreamedScan(n, points_C=points, arrival_time=capture + self._delay_s, device_time=capture))
        output.set_value(ScanStream(tuple(frames)))

    def _joints(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._motion(float(np.mod(context.get_time(), len(self._clouds) / self._rate_hz))))

    def _time(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, context.get_time())
