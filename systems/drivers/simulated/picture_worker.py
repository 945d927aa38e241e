"""Renders pictures in a separate thread while the Diagram advances to their arrival time."""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.geometry import FramePoseVector
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold
from pydrake.systems.sensors import ImageRgba8U, RgbdSensor

PICTURE_THREAD = "pictures"  # prefix of the thread names
Pixels = NDArray[np.uint8]
Finish = Callable[[Pixels], Pixels]
Draw = Callable[[FramePoseVector, Finish], "Future[Pixels]"]


class PictureWorker:
    """Renders a scene at given poses; a picture depends on the poses only, so the time of rendering does not matter.

    A picture arrives 40 ms after its exposure, and rendering takes a quarter of that. In the Diagram's thread it would
    be a quarter of a weld's computing time. A Simulator releases the GIL while it advances; therefore this thread
    advances a small Diagram of its own (scene, camera, a hold that samples the picture) and does not evaluate ports.
    """

    def __init__(self, scene: DiagramBuilder, sensor: RgbdSensor) -> None:
        """`scene`: the builder with the sensor in it and an input `frame_poses`."""
        color = sensor.color_image_output_port()
        hold = scene.AddSystem(ZeroOrderHold(1.0, AbstractValue.Make(ImageRgba8U())))
        scene.Connect(color, hold.get_input_port())
        scene.ExportOutput(hold.get_output_port(), "picture")
        self._diagram: Diagram = scene.Build()
        self._simulator: Simulator | None = None
        self.waiting_since: float | None = None  # wall clock (s, monotonic) of the newest picture while it is not ready
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=PICTURE_THREAD)

    def draw(self, poses: FramePoseVector, finish: Finish) -> Future[Pixels]:
        """Start a picture; the future holds `finish` of its colours (H, W, 4). Pictures are rendered in the order of the calls."""
        self.waiting_since = time.monotonic()
        return self._thread.submit(self._draw, AbstractValue.Make(poses), finish)

    def _draw(self, poses: AbstractValue, finish: Finish) -> Pixels:
        if self._simulator is None:
            self._simulator = Simulator(self._diagram)
        context = self._simulator.get_mutable_context()
        self._diagram.GetInputPort("frame_poses").FixValue(context, poses)
        self._simulator.AdvanceTo(context.get_time() + 1.0)  # the hold samples the picture at the start of this second
        pixels = finish(self._diagram.GetOutputPort("picture").Eval(context).data)
        self.waiting_since = None
        return pixels
