"""Builds small valid files of the forms in which robots and calibration tools store poses, from a seed."""

import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from weldcal.models.arrays import Array
from weldcal.tools.worlds.file_examples import Files, Rng, hand_eye_lists


def _row(*parts: Array, mark: str = ",") -> str:
    return mark.join(f"{v:.7f}" for part in parts for v in np.ravel(part))


def _kuka(k: int, p: Array, turn: Rotation) -> str:
    values = (*1e3 * p, *turn.as_euler("ZYX", degrees=True))
    fields = ",".join(f"{name} {v:.6f}" for name, v in zip("XYZABC", values, strict=True))
    return f"DECL E6POS XP{k}={{{fields},S 2,T 35}}"


def _fanuc(k: int, p: Array, turn: Rotation) -> str:
    x, y, z = 1e3 * p
    w, v, r = turn.as_euler("xyz", degrees=True)
    return (
        f"P[{k}]{{\n   GP1:\n\tX = {x:.4f} mm, Y = {y:.4f} mm, Z = {z:.4f} mm,\n\tW = {w:.5f} deg, P = {v:.5f} deg, R ="
        f" {r:.5f} deg\n}};"
    )


def _rapid(k: int, p: Array, turn: Rotation) -> str:
    return (
        "CONST robtarget"
        f" p{k}:=[[{_row(1e3 * p)}],[{_row(turn.as_quat(scalar_first=True))}],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];"
    )


def _staubli(k: int, p: Array, turn: Rotation) -> str:
    values = (*1e3 * p, *turn.as_euler("XYZ", degrees=True))
    fields = " ".join(f'{n}="{v:.6f}"' for n, v in zip(("x", "y", "z", "rx", "ry", "rz"), values, strict=True))
    return f'<Value key="{k}" {fields} />'


_PROGRAMS: tuple[tuple[str, str, Callable[[int, Array, Rotation], str]], ...] = (
    ("DEFDAT A", "ENDDAT", _kuka),
    ("/POS", "/END", _fanuc),
    ("MODULE M", "ENDMODULE", _rapid),
    ('<Data name="p" type="pointRx" size="12">', "</Data>", _staubli),
    ("def f():", "end", lambda k, p, turn: f"  movel(p[{_row(p, turn.as_rotvec())}], a=1.2, v=0.25)"),
    ("", "", lambda k, p, turn: f"movel(posx({_row(1e3 * p, turn.as_euler('ZYZ', degrees=True))}), vel=100)"),
    (
        "//POS\n///POSTYPE BASE\n///RECTAN",
        "//INST\nEND",
        lambda k, p, turn: f"C{k:05d}={_row(1e3 * p, turn.as_euler('xyz', degrees=True))}",
    ),
    (".TRANS", ".END", lambda k, p, turn: f"p{k} {_row(1e3 * p, turn.as_euler('ZYZ', degrees=True), mark=' ')}"),
    (
        "At time 1.0",
        "",
        lambda k, p, turn: f"- Translation: [{_row(p)}]\n- Rotation: in Quaternion [{_row(turn.as_quat())}]",
    ),
)


def _camera(G: Array) -> bytes:
    rows = [_row(X[:3, 3], Rotation.from_matrix(X[:3, :3]).as_quat()) for X in G]
    return ("x,y,z,qx,qy,qz,qw\n" + "\n".join(rows) + "\n").encode()


def program(rng: Rng) -> Files:
    """A robot program beside a table of the camera's poses."""
    F, G = hand_eye_lists(rng)
    before, after, line = _PROGRAMS[int(rng.integers(len(_PROGRAMS)))]
    rows = [line(k, X[:3, 3], Rotation.from_matrix(X[:3, :3])) for k, X in enumerate(F)]
    return {"set/robot.txt": "\n".join([before, *rows, after]).encode() + b"\n", "set/camera.csv": _camera(G)}


def captions(rng: Rng) -> Files:
    """Matrices below captions, or lines with labels."""
    F, G = hand_eye_lists(rng)
    lines: list[str] = []
    for a, b in zip(F, G, strict=True):
        lines += ["robot:", *(_row(r, mark=" ") for r in a), "camera:", *(_row(r, mark=" ") for r in b)]
    return {"poses.txt": ("\n".join(lines) + "\n").encode()}


def documents(rng: Rng) -> Files:
    """A YAML document for each pose, as ROS prints messages."""
    F, G = hand_eye_lists(rng)
    found = []
    for X in F:
        p, q = X[:3, 3], Rotation.from_matrix(X[:3, :3]).as_quat()
        lines = ["pose:", "  position:", *(f"    {a}: {v:.7f}" for a, v in zip("xyz", p, strict=True))]
        found += [*lines, "  orientation:", *(f"    {a}: {v:.7f}" for a, v in zip("xyzw", q, strict=True)), "---"]
    return {"set/robot.yaml": ("\n".join(found) + "\n").encode(), "set/camera.csv": _camera(G)}


def nested(rng: Rng) -> Files:
    """Samples under numbered keys, with an axis and an angle, a matrix, or fields."""
    F, G = hand_eye_lists(rng)

    def one(X: Array, kind: int) -> Any:
        v = Rotation.from_matrix(X[:3, :3]).as_rotvec()
        angle = float(np.linalg.norm(v))
        if kind == 0:
            return {
                "rotation": {"axis": (v / angle if angle else np.eye(3)[2]).tolist(), "angle": angle},
                "translation": X[:3, 3].tolist(),
            }
        return X.tolist() if kind == 1 else {"rvec": v.tolist(), "tvec": X[:3, 3].tolist()}

    kinds = rng.integers(0, 3, 2)
    samples = {
        f"frame_{k}": {"gripper": one(a, int(kinds[0])), "board": one(b, int(kinds[1]))}
        for k, (a, b) in enumerate(zip(F, G, strict=True))
    }
    return {"pairs.json": json.dumps(samples).encode()}


def matlab(rng: Rng) -> Files:
    """Arrays of MATLAB, with the poses last or in cells."""
    F, G = hand_eye_lists(rng)
    arrays: dict[str, Any] = {"A": np.moveaxis(F, 0, 2), "B": np.moveaxis(G, 0, 2)}
    if rng.random() < 0.5:
        for name, listed in (("A", F), ("B", G)):
            cells = np.empty((1, len(listed)), dtype=object)
            for k, X in enumerate(listed):
                cells[0, k] = X
            arrays[name] = cells
    stream = io.BytesIO()
    savemat(stream, arrays, do_compression=bool(rng.random() < 0.5))  # type: ignore[arg-type]
    return {"pairs.mat": stream.getvalue()}


def folder(rng: Rng) -> Files:
    """A JSON file for each sample."""
    F, G = hand_eye_lists(rng)
    return {
        f"set/sample_{k}.json": json.dumps({"robot": a.tolist(), "camera": b.tolist()}, indent=1).encode()
        for k, (a, b) in enumerate(zip(F, G, strict=True))
    }
