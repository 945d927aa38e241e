"""Pictures drawn in a thread of their own, while the Diagram goes on to the moment at which they arrive."""

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

PICTURE_THREAD = "pictures"  # how these threads are named, for whoever sets their priority
Pixels = NDArray[np.uint8]
Finish = Callable[[Pixels], Pixels]
Draw = Callable[[FramePoseVector, Finish], "Future[Pixels]"]


class PictureWorker:
    """Draws a scene as it stood; a picture depends on the poses alone, so it is the same whenever it is ready.

    A camera's picture arrives 40 ms after its exposure, and drawing takes a quarter of that: done in the Diagram's own
    thread, it would be a quarter of a weld's computing time. A Simulator lets go of Python's lock while it advances, and
    so this thread's own tiny Diagram (scene, camera, a hold that takes the picture) is advanced and not evaluated.
    """

    def __init__(self, scene: DiagramBuilder, sensor: RgbdSensor) -> None:
        """`scene`: the builder with the sensor in it and an input `frame_poses`."""
        color = sensor.color_image_output_port()
        hold = scene.AddSystem(ZeroOrderHold(1.0, AbstractValue.Make(ImageRgba8U())))
        scene.Connect(color, hold.get_input_port())
        scene.ExportOutput(hold.get_output_port(), "picture")
        self._diagram: Diagram = scene.Build()
        self._simulator: Simulator | None = None
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=PICTURE_THREAD)

    def draw(self, poses: FramePoseVector, finish: Finish) -> Future[Pixels]:
        """Begin a picture, `finish` of its colours (H, W, 4); pictures are drawn in the order in which they are asked for."""
        return self._thread.submit(self._draw, AbstractValue.Make(poses), finish)

    def _draw(self, poses: AbstractValue, finish: Finish) -> Pixels:
        if self._simulator is None:
            self._simulator = Simulator(self._diagram)
        context = self._simulator.get_mutable_context()
        self._diagram.GetInputPort("frame_poses").FixValue(context, poses)
        self._simulator.AdvanceTo(context.get_time() + 1.0)  # the hold takes the picture as this second begins
        return finish(self._diagram.GetOutputPort("picture").Eval(context).data)
