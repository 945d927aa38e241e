"""Find poses in robot programs, pose files and what ROS prints, by the words that only these have."""

import re
from collections.abc import Sequence

import numpy as np

from weldcal.calibration.data.poses.listing import Listing, listing_of
from weldcal.calibration.errors import DatasetError

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
_UR_SETTINGS = re.compile(r"set_tcp\s*\(|set_payload\s*\(|set_gravity\s*\(|_tcp\s*=")
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


def _rapid(text: str, name: str) -> Listing | None:
    found = _RAPID.findall(text)
    if not found or "[[" not in text.replace(" ", ""):
        return None
    p, q = np.array([_floats(m[1]) for m in found]), np.array([_floats(m[2]) for m in found])
    return listing_of(
        name, p, q, rotation="quaternion_wxyz", ids=_unique([m[0] for m in found]), unit="mm", form="ABB robtargets"
    )


def _kuka(text: str, name: str) -> Listing | None:
    rows, ids = [], []
    for label, body in _KUKA.findall(text):
        fields = {key.upper(): float(value) for key, value in _KUKA_FIELD.findall(body)}
        if set("XYZABC") <= set(fields):
            rows.append([fields[key] for key in "XYZABC"])
            ids.append(re.sub(r"^X(?=\w)", "", label))
    if not rows:
        return None
    table = np.array(rows)
    return listing_of(
        name,
        table[:, :3],
        table[:, 3:],
        rotation="euler_ZYX",
        angles="deg",
        ids=_unique(ids),
        unit="mm",
        form="KUKA positions",
    )


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
    if not rows:
        return None
    ids = [f"P{number}" for number in _FANUC_POINT.findall(text)]
    table = np.array(rows)
    return listing_of(
        name,
        table[:, :3],
        table[:, 3:],
        rotation="euler_xyz",
        angles="deg",
        ids=_unique(ids) if len(ids) == len(rows) else (),
        unit="mm",
        form="Fanuc positions",
    )


def _transforms(text: str, name: str) -> Listing | None:
    p, q, times = _TF_P.findall(text), _TF_Q.findall(text), _TF_TIME.findall(text)
    if not p or len(p) != len(q):
        return None
    at = np.array([float(t) for t in times]) if len(times) == len(p) else None
    return listing_of(
        name,
        np.array([_floats(v) for v in p]),
        np.array([_floats(v) for v in q]),
        rotation="quaternion_xyzw",
        times=at,
        unit="m",
        form="transforms of tf2_echo",
    )


def _ur(text: str, name: str) -> Listing | None:
    rows = [
        _floats(pose)
        for line in text.splitlines()
        if not line.lstrip().startswith("#") and not _UR_SETTINGS.search(line)
        for pose in _UR.findall(line)
    ]
    if not rows:
        return None
    table = np.array(rows)
    return listing_of(
        name,
        table[:, :3],
        table[:, 3:],
        rotation="rotation_vector",
        angles="rad",
        unit="m",
        form="UR poses (x, y, z, rotation vector)",
    )


def _unique(ids: Sequence[str]) -> tuple[str, ...]:
    named = all(ids) and len(set(ids)) == len(ids)
    return tuple(ids) if named else ()


def _calls(text: str, name: str) -> Listing | None:
    for word, pattern, usual, form in _CALLS:
        rows = [_floats(m) for m in re.findall(pattern, text)] if word.rstrip("(") in text else []
        if len(rows) > 1:
            table = np.array(rows)
            return listing_of(
                name, table[:, :3], table[:, 3:], angles="deg", usual=usual, vector=False, unit="mm", form=form
            )
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
    table = np.array(rows)
    return listing_of(
        name, table[:, :3], table[:, 3:], rotation="euler_xyz", angles="deg", unit="mm", form="Yaskawa positions"
    )


def _staubli(text: str, name: str) -> Listing | None:
    if "pointRx" not in text:
        return None
    found = [dict(_DTX_FIELD.findall(value)) for value in _DTX.findall(text[text.index("pointRx") :])]
    rows = [[float(one[k]) for k in ("x", "y", "z", "rx", "ry", "rz")] for one in found if len(one) == 6]
    if not rows:
        return None
    table = np.array(rows)
    return listing_of(
        name, table[:, :3], table[:, 3:], rotation="euler_XYZ", angles="deg", unit="mm", form="Staubli points"
    )


def _ur_waypoints(text: str, name: str) -> Listing | None:
    rows = [_floats(m) for m in _URP.findall(text)] if "URProgram" in text else []
    if not rows:
        return None
    table = np.array(rows)
    return listing_of(
        name, table[:, :3], table[:, 3:], rotation="rotation_vector", angles="rad", unit="m", form="UR waypoints"
    )


def _halcon(text: str, name: str) -> Listing | None:
    found = _HALCON.findall(text)
    if not found:
        return None
    code = found[0][0]
    if code not in _HALCON_TYPES:
        raise DatasetError(
            f"'{name}' is a HALCON pose of type {code[:9]}; write it as type 0 with convert_pose_type (Rp+T, gba,"
            " point)."
        )
    p, r = (np.array([_floats(m[k]) for m in found]) for k in (2, 1))
    usual = _HALCON_TYPES[code]
    angles = "rad" if usual == "rotation_vector" else "deg"
    return listing_of(name, p, r, rotation=usual, angles=angles, unit="m", form="HALCON poses")


def _kawasaki(text: str, name: str) -> Listing | None:
    if not text.lstrip().startswith(".") or ".TRANS" not in text:
        return None
    block = text[text.index(".TRANS") :].partition("\n.END")[0]
    found = re.findall(rf"^[ \t]*(\w{{1,80}})[ \t]+({NUMBER}(?:[ \t]+{NUMBER}){{5}})[ \t\r]*$", block, re.MULTILINE)
    if not found:
        return None
    table = np.array([_floats(m[1]) for m in found])
    return listing_of(
        name,
        table[:, :3],
        table[:, 3:],
        rotation="euler_ZYZ",
        angles="deg",
        ids=_unique([m[0] for m in found]),
        unit="mm",
        form="Kawasaki transformations",
    )


def list_of_program(text: str, name: str) -> Listing | None:
    """The poses of a robot program, a pose file or a log of transforms; None where the text is none of them.

    Raises:
        DatasetError: it holds joint angles and no poses.
    """
    for program in (
        _rapid,
        _kuka,
        _fanuc,
        _yaskawa,
        _staubli,
        _kawasaki,
        _ur_waypoints,
        _halcon,
        _transforms,
        _ur,
        _calls,
    ):
        found = program(text, name)
        if found is not None:
            return found
    if _JOINTS.search(text):
        raise DatasetError(
            f"'{name}' holds joint angles and no poses: store the points as Cartesian positions in the robot's base, or"
            " write the poses that the controller shows as a table x,y,z,rx,ry,rz."
        )
    return None
