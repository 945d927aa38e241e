"""Find poses in robot programs, pose files and what ROS prints, by the words that only these have."""

import gzip
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from weldcal.calibration.data.poses.listing import Listing, listing_of
from weldcal.calibration.errors import DatasetError
from weldcal.models.files import LARGEST_DOCUMENT, read_text

NUMBER = r"[-+]?(?:\d{1,40}(?:\.\d{0,40})?|\.\d{1,40})(?:[eE][-+]?\d{1,5})?"
"""A number; bounded, so that a search in a long row of digits ends."""
_SIX = rf"{NUMBER}(?:\s*,\s*{NUMBER}){{5}}"
_CALLS = (
    ("posx", rf"\bposx\s*\(\s*\[?\s*({_SIX})", "euler_ZYZ", "Doosan posx"),
    ("XY(", rf"\bXY\s*\(\s*({_SIX})", "euler_ZYX", "Epson points"),
    (")(", rf"=\s*\(\s*({_SIX})(?:\s*,\s*{NUMBER})*\s*\)\s*\(", "euler_xyz", "Mitsubishi positions"),
    ("POS(", rf"\bPOS\s*\(\s*({_SIX})", "euler_ZYZ", "Comau positions"),
    ("P(", rf"(?<!\w)P\s*\(\s*({_SIX})", "euler_xyz", "Denso positions"),
)
"""A word of each, the pattern of a pose, the usual notation of its angles, and its name; lengths in mm, angles in
degrees."""
_JOB = re.compile(rf"^[A-Z]{{1,2}}\d{{3,5}}=({_SIX})", re.MULTILINE)
_DTX = re.compile(r"<Value\b([^<>]{0,2000})>")
_DTX_FIELD = re.compile(rf'\b(x|y|z|rx|ry|rz)="({NUMBER})"')
_URP = re.compile(rf'\bpose="({_SIX})"')
_HALCON = re.compile(
    rf"^f\s+(\d+)\s*^r\s+({NUMBER}\s+{NUMBER}\s+{NUMBER})\s*^t\s+({NUMBER}\s+{NUMBER}\s+{NUMBER})", re.MULTILINE
)
_HALCON_TYPES = {"0": "euler_XYZ", "2": "euler_xyz", "4": "rotation_vector"}
_JOINTS = re.compile(
    rf"\bjointtarget\b|\bE6AXIS\b|\bAXIS\s*:\s*A1\b|\bA1\s+{NUMBER}\s*,\s*A2\s|\bJ1\s*=\s*{NUMBER}\s*deg"
    rf"|^\s*movej\s*\(\s*\[",
    re.MULTILINE,
)
_UR = re.compile(rf"p\s*\[\s*({NUMBER}(?:\s*,\s*{NUMBER}){{5}})\s*\]")
_UR_SETTINGS = re.compile(r"(?i)set_tcp\s*\(|set_payload\s*\(|set_gravity\s*\(|tcp\s*:?=")
_TFM = re.compile(r"(?m)^Parameters:((?:[ \t]+\S+){12})[ \t\r]*$")
_G2O = re.compile(rf"(?m)^VERTEX_SE3:QUAT[ \t]+(\d+)((?:[ \t]+{NUMBER}){{7}})[ \t\r]*$")
_RAPID = re.compile(
    rf"(?:\b(\w{{1,80}})\s{{0,9}}:=\s{{0,9}})?\[\s*\[({NUMBER}(?:\s*,\s*{NUMBER}){{2}})\]"
    rf"\s*,\s*\[({NUMBER}(?:\s*,\s*{NUMBER}){{3}})\]"
)
_KUKA = re.compile(r"(?:\b(\w{1,80})\s{0,9}=\s{0,9})?\{([^{}]{10,2000})\}")
_KUKA_FIELD = re.compile(rf"\b([XYZABC])\s+({NUMBER})", re.IGNORECASE)
_FANUC_FIELD = re.compile(rf"\b([XYZWPR])\s*[=:]\s*({NUMBER})\s*(mm|deg)?", re.IGNORECASE)
_FANUC_POINT = re.compile(r"\bP\[\s*(\d+)[^\]]*\]\s*\{")
_TF_P = re.compile(rf"Translation:\s*\[\s*({NUMBER}(?:\s*,\s*{NUMBER}){{2}})\s*\]")
_TF_Q = re.compile(rf"in Quaternion(?:\s*\(xyzw\))?\s*\[\s*({NUMBER}(?:\s*,\s*{NUMBER}){{3}})\s*\]")
_TF_TIME = re.compile(rf"At time\s+({NUMBER})")


def _floats(text: str) -> list[float]:
    return [float(v) for v in re.findall(NUMBER, text)]


def _listed(
    name: str,
    rows: Sequence[Sequence[float]],
    form: str,
    unit: str,
    rotation: str = "",
    ids: Sequence[str] = (),
    **more: Any,
) -> Listing | None:
    """The list of rows (n, 6 or 7), each a position and a rotation; None without rows, and no names but unique ones."""
    if not rows:
        return None
    table = np.array(rows)
    named = len(ids) == len(rows) == len(set(ids)) and all(ids)
    more |= {"angles": "deg"} if rotation.startswith("euler") else {"angles": "rad"} if "vector" in rotation else {}
    return listing_of(
        name,
        table[:, :3],
        table[:, 3:],
        rotation=rotation,
        ids=tuple(ids) if named else (),
        unit=unit,
        form=form,
        **more,
    )


def _rapid(text: str, name: str) -> Listing | None:
    found = _RAPID.findall(text) if "[[" in text.replace(" ", "") else []
    rows = [_floats(m[1]) + _floats(m[2]) for m in found]
    return _listed(name, rows, "ABB robtargets", "mm", "quaternion_wxyz", [m[0] for m in found])


def _kuka(text: str, name: str) -> Listing | None:
    rows, ids = [], []
    for label, body in _KUKA.findall(text):
        fields = {key.upper(): float(value) for key, value in _KUKA_FIELD.findall(body)}
        if set("XYZABC") <= set(fields):
            rows.append([fields[key] for key in "XYZABC"])
            ids.append(re.sub(r"^X(?=\w)", "", label))
    return _listed(name, rows, "KUKA positions", "mm", "euler_ZYX", ids)


def _fanuc(text: str, name: str) -> Listing | None:
    if not re.search(r"\bW\s*[=:]\s*" + NUMBER + r"\s*deg", text, re.IGNORECASE):
        return None
    rows: list[list[float]] = []
    fields: dict[str, float] = {}
    for key, value, _ in _FANUC_FIELD.findall(text):
        fields[key.upper()] = float(value)
        if set("XYZWPR") <= set(fields):
            rows.append([fields[k] for k in "XYZWPR"])
            fields = {}
    ids = [f"P{number}" for number in _FANUC_POINT.findall(text)]
    return _listed(name, rows, "Fanuc positions", "mm", "euler_xyz", ids)


def _transforms(text: str, name: str) -> Listing | None:
    p, q, times = _TF_P.findall(text), _TF_Q.findall(text), _TF_TIME.findall(text)
    rows = [_floats(a) + _floats(b) for a, b in zip(p, q, strict=True)] if len(p) == len(q) else []
    at = np.array([float(t) for t in times]) if len(times) == len(p) else None
    return _listed(name, rows, "transforms of tf2_echo", "m", "quaternion_xyzw", times=at)


def _ur(text: str, name: str) -> Listing | None:
    rows = [
        _floats(pose)
        for line in text.splitlines()
        if not line.lstrip().startswith("#") and not _UR_SETTINGS.search(line)
        for pose in _UR.findall(line)
    ]
    tcp = re.search(rf"(?m)^[^#\n]*set_tcp\s*\(\s*p\s*\[\s*({_SIX})", text)
    form = "UR poses (x, y, z, rotation vector)"
    if tcp is not None and any(_floats(tcp[1])):
        form += f" of the TCP {tcp[1]}, not of the flange"
    return _listed(name, rows, form, "m", "rotation_vector")


def _calls(text: str, name: str) -> Listing | None:
    for word, pattern, usual, form in _CALLS:
        rows = [_floats(m) for m in re.findall(pattern, text)] if word.rstrip("(") in text else []
        if len(rows) > 1:
            return _listed(name, rows, form, "mm", angles="deg", usual=usual, vector=False)
    return None


def _yaskawa(text: str, name: str) -> Listing | None:
    if "///POSTYPE" not in text:
        return None
    rows: list[list[float]] = []
    for block in re.split(r"///POSTYPE\s+", text)[1:]:
        if not block.startswith(("PULSE", "ANGLE")):
            rows += [_floats(m) for m in _JOB.findall(block)]
    if not rows:
        raise DatasetError(
            f"'{name}' holds pulses of the joints, not poses. Convert the job to a relative job in base coordinates on"
            " the pendant, or write the poses that the pendant shows in base coordinates as a table x,y,z,rx,ry,rz."
        )
    return _listed(name, rows, "Yaskawa positions", "mm", "euler_xyz")


def _staubli(text: str, name: str) -> Listing | None:
    if "pointRx" not in text:
        return None
    found = [dict(_DTX_FIELD.findall(value)) for value in _DTX.findall(text[text.index("pointRx") :])]
    rows = [[float(one[k]) for k in ("x", "y", "z", "rx", "ry", "rz")] for one in found if len(one) == 6]
    return _listed(name, rows, "Staubli points", "mm", "euler_XYZ")


def _ur_waypoints(text: str, name: str) -> Listing | None:
    rows = [_floats(m) for m in _URP.findall(text)] if "URProgram" in text else []
    return _listed(name, rows, "UR waypoints", "m", "rotation_vector")


def _halcon(text: str, name: str) -> Listing | None:
    found = _HALCON.findall(text)
    code = found[0][0] if found else "0"
    if code not in _HALCON_TYPES:
        raise DatasetError(
            f"'{name}' is a HALCON pose of type {code[:9]}; write it as type 0 with convert_pose_type (Rp+T, gba,"
            " point)."
        )
    return _listed(name, [_floats(t) + _floats(r) for _, r, t in found], "HALCON poses", "m", _HALCON_TYPES[code])


def _kawasaki(text: str, name: str) -> Listing | None:
    if not text.lstrip().startswith(".") or ".TRANS" not in text:
        return None
    block = text[text.index(".TRANS") :].partition("\n.END")[0]
    found = re.findall(rf"^[ \t]*(\w{{1,80}})[ \t]+({NUMBER}(?:[ \t]+{NUMBER}){{5}})[ \t\r]*$", block, re.MULTILINE)
    rows = [_floats(m[1]) for m in found]
    return _listed(name, rows, "Kawasaki transformations", "mm", "euler_ZYZ", [m[0] for m in found])


def _itk(text: str, name: str) -> Listing | None:
    found = [_floats(m) for m in _TFM.findall(text)] if "Insight Transform File" in text else []
    if not found:
        return None
    rows = np.array(found)
    form = "ITK transforms (LPS: x and y negated)"
    return listing_of(name, rows[:, 9:], rows[:, :9].reshape(-1, 3, 3), rotation="matrix", unit="mm", form=form)


def _g2o(text: str, name: str) -> Listing | None:
    found = _G2O.findall(text)
    rows = [_floats(m[1]) for m in found]
    return _listed(name, rows, "g2o vertices", "m", "quaternion_xyzw", [m[0] for m in found])


def unzipped(path: Path) -> str:
    """Return the text of a robot program that is stored compressed, or plain. Raises InputError."""
    try:
        with gzip.open(path) as stream:
            found = stream.read(LARGEST_DOCUMENT + 1)
    except gzip.BadGzipFile:
        return read_text(path)
    except (OSError, EOFError, zlib.error) as problem:
        raise DatasetError(f"'{path.name}' is damaged: its compressed text does not end.") from problem
    if len(found) > LARGEST_DOCUMENT:
        raise DatasetError(f"'{path.name}' holds more than {LARGEST_DOCUMENT // 2**20} MiB of text.")
    return found.decode("utf-8", "replace")


def list_of_program(text: str, name: str) -> Listing | None:
    """Return the poses of a robot program, a pose file or a log of transforms; None where the text is none of them.

    Raises:
        DatasetError: it holds joint angles and no poses.
    """
    arms = (_rapid, _kuka, _fanuc, _yaskawa, _staubli, _kawasaki)
    for program in (*arms, _ur_waypoints, _halcon, _transforms, _ur, _calls, _itk, _g2o):
        found = program(text, name)
        if found is not None:
            return found
    if _JOINTS.search(text):
        raise DatasetError(
            f"'{name}' holds joint angles and no poses: store the points as Cartesian positions in the robot's base, or"
            " write the poses that the controller shows as a table x,y,z,rx,ry,rz."
        )
    return None
