"""Poses of any arm: what people paste, programs print and controllers send; nothing but reading goes to a UR."""

from __future__ import annotations

import json
import socket
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.hardware.emulator_process import Emulator, emulator  # noqa: F401
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.errors import InputError
from weldcal.systems.drivers import arm_poses
from weldcal.systems.drivers.arm_poses import ArmSource, NoPose, TypedPose, UrPose, arm_source, pose_of_text
from weldcal.systems.drivers.ur.wire.line import SocketLine

SIX = (400.1, -20.25, 300.0, 179.5, 0.25, -90.0)


@pytest.mark.parametrize(
    "text",
    [
        "400.1, -20.25, 300, 179.5, 0.25, -90",
        "400.1 -20.25 300 179.5 0.25 -90\n",
        "p[400.1, -20.25, 300.0, 179.5, 0.25, -90.0]",
        "X 400.1 Y -20.25 Z 300.0 A 179.5 B 0.25 C -90.0",
        "{X 400.1,Y -20.25,Z 300,A 179.5,B 0.25,C -90}",
        "X=400.1\tY=-20.25\tZ=300.0\tW=179.5\tP=0.25\tR=-90.0",
        "400,1; -20,25; 300; 179,5; 0,25; -90",
        "400,1 -20,25 300,0 179,5 0,25 -90,0",
        "(400.1mm,-20.25mm,300.0mm,179.5deg,0.25deg,-90.0deg)",
        "4.001e2 -2.025E1 3e2 1.795e+2 2.5e-1 -9e1",
        "[[400.1,-20.25,300],[179.5,.25,-90.]]",
        "TCP: 400.1 / -20.25 / 300.0 / 179.5 / 0.25 / -90.0",
    ],
)
def test_six_numbers_are_read_in_the_notations_of_robots(text: str) -> None:
    assert pose_of_text(text).numbers == SIX


def test_a_matrix_is_a_pose_whichever_way_it_is_printed() -> None:
    X = RigidTransform(RollPitchYaw(0.3, -0.5, 1.2), [0.4, -0.2, 0.3])
    M = X.GetAsMatrix4()
    for printed in (M, M.T, M[:3]):
        found = pose_of_text(np.array2string(printed, separator=", ", precision=9)).X_BF
        assert found is not None
        assert found.IsNearlyEqualTo(X, 1e-6)
    M[:3, 3] *= 1e3
    found = pose_of_text(json.dumps(M.tolist())).X_BF
    assert found is not None
    assert found.IsNearlyEqualTo(X, 1e-6)
    M[0, 0] += 0.1
    with pytest.raises(NoPose, match="not orthonormal"):
        pose_of_text(json.dumps(M.tolist()))


@pytest.mark.parametrize("text", ["", "1 2 3", "1 2 3 4 5 6 7 8", "joints"])
def test_a_text_without_a_pose_says_how_many_numbers_it_holds(text: str) -> None:
    with pytest.raises(NoPose, match=f"holds {len(text.split()) if text[:1].isdigit() else 0}"):
        pose_of_text(text)


def test_a_number_beyond_any_arm_is_refused() -> None:
    with pytest.raises(NoPose, match=r"'1e\+07' is beyond any arm"):
        pose_of_text("10000000 0 0 0 0 0")


@pytest.mark.parametrize("text", ["ur:", "tcp:x", "tcp:99999", "file:", "command:", "rtde", "driver:"])
def test_an_unknown_source_is_refused_with_those_that_there_are(text: str) -> None:
    with pytest.raises(InputError, match="ur:HOST, file:PATH, tcp:PORT, command:PROGRAM or driver:NAME"):
        arm_source(text)


def read(source: ArmSource) -> tuple[float, ...]:
    until = time.monotonic() + 5.0
    while True:
        try:
            return source.pose().numbers
        except NoPose:
            if time.monotonic() > until:
                raise
            time.sleep(0.02)


def test_a_file_that_grows_and_a_folder_of_files(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    source = arm_source(f"file:{log}")
    with pytest.raises(NoPose, match="let the robot's program write one"):
        source.pose()
    log.write_text("1 2 3 4 5 6\n" + " ".join(map(str, SIX)) + "\n\n")
    assert read(source) == SIX
    folder = tmp_path / "poses"
    folder.mkdir()
    (folder / "a.txt").write_text("1 2 3 4 5 6")
    time.sleep(0.02)
    (folder / "b.txt").write_text(" ".join(map(str, SIX)))
    assert read(arm_source(f"file:{folder}")) == SIX


def test_a_program_that_prints_the_pose() -> None:
    program = f"command:{sys.executable} -c \"print('{' '.join(map(str, SIX))}')\""
    assert read(arm_source(program)) == SIX
    with pytest.raises(NoPose, match=r"ended with an error: .*no arm"):
        arm_source(f"command:{sys.executable} -c \"raise SystemExit('no arm')\"").pose()
    with pytest.raises(NoPose, match="cannot be run"):
        arm_source("command:/no/such/program").pose()


@pytest.mark.parametrize(
    "line",
    [
        json.dumps(SIX),
        json.dumps({"pose": SIX}),
        json.dumps(dict(zip(("x", "y", "z", "rx", "ry", "rz"), SIX, strict=True))),
        json.dumps(dict(zip(("X", "Y", "Z", "A", "B", "C"), SIX, strict=True))),
        " ".join(map(str, SIX)),
    ],
)
def test_lines_over_tcp_on_this_computer(line: str) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    source = arm_source(f"tcp:{port}")
    try:
        with pytest.raises(NoPose, match="send a line"):
            source.pose()
        with socket.create_connection(("127.0.0.1", port)) as robot:
            robot.sendall(b"1 2 3 4 5 6\n" + line.encode() + b"\n" + b"9 9")
            assert read(source) in ((1.0, 2.0, 3.0, 4.0, 5.0, 6.0), SIX)
            time.sleep(0.1)
            assert read(source) == SIX, "a line that is not whole is not read"
        with pytest.raises(InputError, match="cannot be used"):
            arm_source(f"tcp:{port}")
    finally:
        source.close()


def test_a_driver_with_a_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    class Module:
        __name__ = "makers.arm_x"

        @staticmethod
        def pose() -> list[float]:
            return list(SIX)

    monkeypatch.setattr(arm_poses, "plugins", lambda: (Module(),))
    assert read(arm_source("driver:arm_x")) == SIX
    with pytest.raises(InputError, match="there is arm_x"):
        arm_source("driver:arm_y")


def test_what_is_typed_last_counts() -> None:
    source = arm_source("")
    assert isinstance(source, TypedPose)
    with pytest.raises(NoPose, match="copy that of the flange"):
        source.pose()
    source.typed = "1,2,3,4,5,6"
    assert source.pose().numbers == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


def test_a_ur_is_only_read(emulator: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    """Every byte that is sent is a request of version, outputs, start or pause; a TCP is taken out."""
    kinds: list[str] = []
    send = SocketLine.send

    def noted(line: SocketLine, data: bytes) -> None:
        kinds.append(chr(data[2]))
        assert int.from_bytes(data[:2], "big") == len(data), "one package at a time"
        send(line, data)

    monkeypatch.setattr(SocketLine, "send", noted)
    source = UrPose(emulator.host)
    found = [source.pose() for _ in range(2)]
    emulator.fault("wrong_tcp")  # 100 mm along z
    found.append(source.pose())
    source.close()
    assert set(kinds) <= set("VvOSP")
    assert found[0].q is not None
    assert len(found[0].q) == 6
    assert max(found[0].moved(found[2])) < 1e-6
    assert found[0].X_BF is not None
    flange = forward_kinematics(load_arm("ur10e"), found[0].q)
    assert flange.IsNearlyEqualTo(found[0].X_BF, 1e-5), "by the arm's own kinematics"
    source = UrPose("127.0.0.9")
    with pytest.raises(NoPose):
        source.pose()
