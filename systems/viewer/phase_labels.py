"""Labels of the job's phases in the viewer: one textured board per phase, shown during the phase."""

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.systems.bodies.textured_board import textured_board
from weldcal.systems.phase_words import STEPS, TEXT

__all__ = ["HEIGHT_M", "STEPS", "TEXT", "WIDTH_M", "X_WS", "add_phase_label", "label_image"]

WIDTH_M, HEIGHT_M = 0.72, 0.09
# Above and behind the cell, facing a viewer in front of the robot (+x) who looks towards it.
X_WS = RigidTransform(RollPitchYaw(np.pi / 2, 0.0, np.deg2rad(65.0)), [-0.25, -0.38, 1.0])


def label_image(text: str) -> NDArray[np.uint8]:
    """Draw a (128, 1024, 3) uint8 BGR image with the text."""
    board = np.full((128, 1024, 3), (46, 38, 33), dtype=np.uint8)
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 1.6, 2)
    cv2.putText(board, text, ((1024 - width) // 2, 82), cv2.FONT_HERSHEY_DUPLEX, 1.6, (240, 240, 240), 2, cv2.LINE_AA)
    return board


def add_phase_label(meshcat: Meshcat, path: str, phase: str) -> None:
    """Add the board of a phase at the Meshcat path `path`."""
    board = textured_board(f"phase_{phase}", WIDTH_M, HEIGHT_M, label_image(TEXT.get(phase, phase)))
    meshcat.SetObject(path, board)
    meshcat.SetTransform(path, X_WS)
