"""Frames of a GenICam device, asked for one by one or taken as they come."""

from abc import abstractmethod
from typing import Any, TypeVar

from numpy.typing import NDArray

from weldcal.systems.drivers.sensors.acquisition import Delivery, Garbage, Source
from weldcal.systems.drivers.sensors.genicam.device import Component, GenicamDevice

Datum = TypeVar("Datum", bound=NDArray[Any])


class GenicamSource(Source[Datum]):
    """A device as a source. `trigger` is the command that takes a frame; empty: the device runs freely."""

    def __init__(self, device: GenicamDevice, title: str, trigger: str = "") -> None:
        self.device, self.name, self._trigger = device, title, trigger
        self._request, self._skip = 0, 0

    @abstractmethod
    def datum(self, components: tuple[Component, ...]) -> Datum:
        """The datum of a frame's components. Raises Garbage."""

    def open(self) -> None:
        """See Source."""
        self.device.open()

    def ask(self, request: int) -> None:
        """See Source."""
        while self.device.take(0.001) is not None:  # frames of before the request
            pass
        self._request = request
        if self._trigger:
            self.device.execute(self._trigger)
        else:
            self._skip = 1  # the frame whose exposure was under way

    def next(self, timeout_s: float) -> Delivery[Datum] | None:
        """See Source."""
        taken = self.device.take(timeout_s)
        if taken is None:
            return None
        if self._skip:
            self._skip -= 1
            return None
        try:
            datum = self.datum(taken.components)
        except Garbage as error:
            raise Garbage(f"in frame {taken.number}: {error}") from error
        return Delivery(
            datum=datum,
            arrived=taken.arrived,
            device_time=taken.device_time,
            number=taken.number,
            request=self._request,
        )

    def close(self) -> None:
        """See Source."""
        self.device.close()
