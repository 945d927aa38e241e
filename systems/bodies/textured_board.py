"""A flat mesh textured with a picture, such as the printed tag or a phase label."""

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh


def textured_board(
    name: str, width_m: float, height_m: float, picture: NDArray[np.uint8], *, glows: bool = False
) -> Mesh:
    """A rectangle centred on the origin in the x-y plane, facing +z, x to the right of the picture and y up.

    `picture` is (h, w) grey or (h, w, 3) BGR uint8. Renderers interpolate between its pixels, so its edges are smooth,
    as in a camera's picture of a print. `glows`: a viewer shows it as bright from every side of the light. Edges of
    geometry would be aliased.
    """
    w, h = 0.5 * width_m, 0.5 * height_m
    obj = (
        f"mtllib {name}.mtl\nusemtl board\nv {-w} {-h} 0\nv {w} {-h} 0\nv {w} {h} 0\nv {-w} {h} 0\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"
    )
    mtl = f"newmtl board\nKa 1 1 1\nKd 1 1 1\nmap_Kd {name}.png\n"
    if glows:
        mtl = f"newmtl board\nKa 0 0 0\nKd 0 0 0\nKe 1 1 1\nmap_Ke {name}.png\n"
    colour = picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    png = cv2.imencode(".png", colour)[1].tobytes()
    files = {
        f"{name}.mtl": MemoryFile(mtl, ".mtl", f"{name}.mtl"),
        f"{name}.png": MemoryFile(png, ".png", f"{name}.png"),
    }
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(obj, ".obj", f"{name}.obj"), supporting_files=files))
