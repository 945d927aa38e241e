"""No program and no request ends the emulator or stops its clock: chosen ones, then programs that a seed has mutated.

`python -m weldcal.tests.hardware.test_emulator_mutations 1000 SEED` runs a longer row and prints what happened.
"""

from __future__ import annotations

import json
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from weldcal.systems.drivers.ur.robot import guard_script
from weldcal.tools.emulators.ur.process import Emulator, emulator_process

LONGEST_S = 3.0  # for an answer: the emulator's clock stands still where it takes longer
PRIMARY, REAL_TIME = 30001, 30003

CONTROL = """def control():
  global command = 0
  global target = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  global pose = p[0.4, -0.2, 0.5, 0.0, 3.14, 0.0]
  def read_six(first):
    local i = 0
    local found = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    while i < 6:
      found[i] = read_input_float_register(first + i)
      i = i + 1
    end
    return found
  end
  thread stream():
    while True:
      if command == 9:
        speedj(target, 1.4, 0.002)
      elif command == 10:
        speedl(target, 0.5, 0.002)
      elif command == 11:
        servoj(get_inverse_kin(pose), t=0.002, lookahead_time=0.1, gain=300)
      else:
        sync()
      end
    end
  end
  rtde_set_watchdog("input_int_register_0", 1, "stop")
  number = run stream()
  n = 0
  while n < 40:
    enter_critical
    command = 9 + n % 3
    target = read_six(0) * 0.1 + [0.01, 0.0, 0.0, 0.0, 0.0, 0.02]
    exit_critical
    write_output_integer_register(0, 1 + n % 2)
    write_output_float_register(0, norm(target) / (1 + n))
    n = n + 1
    sync()
  end
  kill number
  stopj(2.0)
  movej([0.0, -1.5, 1.5, -1.5, -1.5, 0.1], a=1.4, v=1.05)
  textmsg("ended at ", get_actual_tcp_pose())
end
"""
SMALL = (
    'def talk():\n  x = str_cat("a", 1)\n  popup(x, title="Title", blocking=False)\n  textmsg(x, [1, 2, x])\nend\n',
    (
        "def lists():\n  m = [[1, 2, 3], [4, 5, 6]]\n  v = m * [1, 0, 1]\n  m[1][2] = v[0]\n  l = make_list(3, 0)\n "
        " l.append(7)\n  s = struct(a=m, b=l)\n  textmsg(s.a, transpose(m))\n  while length(l) > 0:\n    l.remove(0)\n "
        " end\nend\n"
    ),
    (
        "def moves():\n  set_tcp(p[0, 0, 0.1, 0, 0, 0])\n  movel(pose_trans(get_actual_tcp_pose(), p[0.02, 0, 0, 0, 0,"
        " 0.1]), 1.2, 0.2)\n  movec(pose_add(get_actual_tcp_pose(), p[0.01, 0.01, 0, 0, 0, 0]), p[0.4, 0.1, 0.5, 0, 3,"
        " 0], a=1, v=0.1)\n  force_mode(p[0,0,0,0,0,0], [0, 0, 1, 0, 0, 0], [0, 0, -5, 0, 0, 0], 2, [0.1, 0.1, 0.1,"
        " 0.1, 0.1, 0.1])\n  sleep(0.02)\n  end_force_mode()\n  stopl(2.0)\nend\n"
    ),
    (
        'def wires():\n  ok = socket_open("127.0.0.1", 9, "s")\n  if not ok:\n    set_standard_digital_out(2, True)\n '
        ' end\n  socket_send_line("x", "s")\n  a = socket_read_byte_list(4, "s", 0.01)\n  set_standard_analog_out(0,'
        " 0.5)\nend\n"
    ),
    (
        "def deep(a=1, b=[2, 3]):\n  def again(n):\n    if n > 0:\n      return again(n - 1) + 1\n    end\n    return"
        " 0\n  end\n  x = again(20)\n  y = binary_list_to_integer(integer_to_binary_list(x))\n  z = pow(2, y) % 7\n "
        " halt\nend\n"
    ),
    "sec beside():\n  set_tool_voltage(24)\n  set_payload(1.5, [0, 0, 0.1])\n  textmsg(to_num(to_str(1.5)))\nend\n",
)
WORDS = (
    *(
        "0",
        "-1",
        "1",
        "2000000000",
        "9" * 5000,
        "1e308",
        "1e999",
        "0.0",
        "True",
        "None",
        '"text"',
        '""',
        "[]",
        "[[]]",
        "p[0,0,0,0,0,0]",
    ),
    *(
        "x",
        "m",
        "target",
        "norm",
        "make_list",
        "str_cat",
        "pow",
        "get_inverse_kin",
        "textmsg",
        "sync()",
        "run",
        "kill",
        "join",
    ),
    *(
        "while True:",
        "while",
        "if",
        "else:",
        "elif True:",
        "end",
        "def",
        "thread",
        "sec",
        "return",
        "break",
        "continue",
        "halt",
    ),
    *(
        "(",
        ")",
        "[",
        "]",
        ",",
        ":",
        "=",
        "==",
        "+",
        "-",
        "*",
        "/",
        "%",
        "<",
        ".",
        "not",
        "and",
        "xor",
        "global",
        "local",
        "\n",
    ),
    *(
        "[" * 150,
        "(" * 150,
        "not " * 300,
        "lambda",
        "yield",
        "class",
        "\\",
        "\0",
        "é",
        "#",
        "$ 1",
        "a = str_cat(a, a)\n",
    ),
    *(
        "l = [l, l, l, l]\n",
        "x = x * x\n",
        "x = x + x\n",
        "movej(1e300)\n",
        "set_tcp(p[1e300,0,0,0,0,0])\n",
        "again(n)",
        "rpc_factory",
    ),
)


def mutated(source: str, rng: np.random.Generator) -> str:
    """The program with one to three changes: words replaced, put in, taken out or exchanged, lines doubled or lost."""
    for _ in range(int(rng.integers(1, 4))):
        lines = source.splitlines(keepends=True)
        # the first line stays, and mostly the last, so that the controller takes the text for a program
        at = int(rng.integers(1, max(2, len(lines) - int(rng.random() < 0.9))))
        line = lines[at] if at < len(lines) else ""
        words = line.split(" ")
        k, word = int(rng.integers(len(words))), str(rng.choice(np.array(WORDS, dtype=object)))
        match int(rng.integers(8)):
            case 0:
                words[k] = word
            case 1:
                words.insert(k, word)
            case 2:
                del words[k]
            case 3:
                other = lines[int(rng.integers(1, max(2, len(lines) - 1)))] if len(lines) > 2 else line
                words = [other]
            case 4:
                words = [line, line]
            case 5:
                place = int(rng.integers(len(line) + 1))
                words = [line[:place] + word + line[place:]]
            case 6:
                digits = [i for i, c in enumerate(line) if c.isdigit()]
                i = int(rng.choice(digits)) if digits else 0
                words = [line[:i] + word + line[i + 1 :]] if digits else words
            case _:
                words = [word + "\n", line]
        lines[at : at + 1] = [" ".join(words)]
        source = "".join(lines)
    return source if source.endswith("\n") else source + "\n"


def programs(seed: int) -> Iterator[str]:
    """Mutants of the guard, of a control program and of small programs, without end."""
    rng = np.random.default_rng(seed)
    bases = (guard_script(True, 3), CONTROL, *SMALL)
    while True:
        yield mutated(bases[int(rng.integers(len(bases)))], rng)


def sent(emulator: Emulator, source: str, port: int = REAL_TIME, frames: int = 10) -> dict[str, Any]:
    """The state after some frames of a program, with how long the answers took; the program is stopped."""
    before, start = emulator.state(), time.monotonic()
    with socket.create_connection((emulator.host, port), timeout=LONGEST_S) as wire:
        wire.sendall(source.encode())
        wire.shutdown(socket.SHUT_WR)
        begin = emulator.state()["frame"]
        while True:
            state = emulator.state()
            if state["frame"] >= begin + frames:
                break
            time.sleep(0.001)
    longest = time.monotonic() - start
    emulator.do("recover")
    emulator.do("set_q", q=[0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
    return state | {"took": longest, "started": state["programs_started"] > before["programs_started"]}


@pytest.fixture(scope="module")
def emulator() -> Iterator[Emulator]:
    with emulator_process() as made:
        yield made


def body(*lines: str) -> str:
    """A program of these lines."""
    return "\n".join(("def wrong():", *lines, "end\n"))


REFUSED = {  # by the compiler, with a part of its sentence
    "a break outside of a loop": (body("break"), "'break' outside of a loop"),
    "a continue outside of a loop": (body("if True:", "continue", "end"), "'continue' outside of a loop"),
    "an argument named twice": (body("def f(a, a):", "return a", "end"), "a second parameter 'a'"),
    "a keyword given twice": (body("movej([0,0,0,0,0,0], a=1, a=2)"), "a second 'a'"),
    "120 nested blocks": (body(*["if True:"] * 120, *["end"] * 120), "nested too deeply"),
    "30 nested loops": (body(*["while True:"] * 30, *["end"] * 30), "nested too deeply"),
    "5000 nested parentheses": (body("x = " + "(" * 5000 + "1" + ")" * 5000), "nested too deeply"),
    "5000 digits": (body("x = " + "9" * 5000), "is too large"),
    "a float beyond all": (body("x = 1e999"), "is too large"),
    "a keyword of Python": (body("movej([0,0,0,0,0,0], lambda=1)"), "invalid syntax"),
    "a motion as a default": (body("def f(a=movej([0,0,0,0,0,0])):", "end"), "outside function"),
    "more than a million characters": (body("#" * 1_100_000), "characters"),
}
STOPPED = {  # while they run
    "a text that doubles": (body('x = "ab"', "while True:", "x = str_cat(x, x)", "end"), "elements or characters"),
    "a list of two billion": (body("x = make_list(2000000000, 0)"), "elements"),
    "a list in a list in a list": (body("x = [1, 2]", "while True:", "x = [x, x]", "end"), "nested too deeply"),
    "a wide list of lists": (body("x = make_list(1000, make_list(1000, 0))"), "elements"),
    "a list that grows inside": (
        body("x = [[1]]", "b = make_list(50000, 0)", "while True:", "x[0].append(b)", "end"),
        "elements|too much behind",
    ),
    "appending for ever": (body("x = [1]", "while True:", "x.append(1)", "end"), "too much behind"),
    "calculating with long lists": (body("x = make_list(90000, 1.0)", *["x = x + x"] * 500), "too much behind"),
    "a product of large matrices": (body("x = make_list(300, make_list(300, 1.0))", "x = x * x"), "too much behind"),
    "a number that squares": (body("x = 10", "while True:", "x = x * x", "end"), "64 bits"),
    "a number of a text": (body(f'x = to_num("{"9" * 4000}")'), "64 bits"),
    "a power": (body("x = pow(10, 1000000000)"), "math range error"),
    "a call without end": (body("def f(n):", "return f(n + 1)", "end", "x = f(0)"), "too deeply|too much behind"),
    "calls that double": (
        body("def f(n):", "if n > 0:", "f(n - 1)", "f(n - 1)", "end", "end", "f(40)"),
        "too much behind",
    ),
    "a loop that never waits": (body("while True:", "x = 1", "end"), "takes no time"),
    "a loop of inverse kinematics": (
        body("while True:", "x = get_inverse_kin(p[0.4, -0.2, 0.5, 0, 3, 0])", "end"),
        "too much behind",
    ),
    "threads without end": (body("thread t():", "sleep(9)", "end", "while True:", "run t()", "end"), "threads"),
    "sockets without end": (
        body("i = 0", "while True:", f'socket_open("127.0.0.1", {PRIMARY}, to_str(i))', "i = i + 1", "end"),
        "sockets|on loopback|Connection",
    ),
    "two billion bytes": (body('socket_open("127.0.0.1", 1)', "x = socket_read_byte_list(2000000000)"), "0 to 1000"),
    "a number as an action": (body('rtde_set_watchdog("x", 1, 1)'), "lower"),
    "an index past the end": (body("x = [1]", "x.remove(5)"), "out of range"),
    "a list as a name": (body("kill [1]"), "unhashable"),
}


def log_of(emulator: Emulator, source: str, frames: int = 60) -> str:
    """What the controller wrote down about a program."""
    before = set(emulator.ask(ask="log")["log"])
    assert sent(emulator, source, PRIMARY, frames)["took"] < LONGEST_S
    return "\n".join(line for line in emulator.ask(ask="log")["log"] if line not in before)


@pytest.mark.parametrize("name", REFUSED)
def test_a_wrong_program_is_a_compile_error(name: str, emulator: Emulator) -> None:
    source, sentence = REFUSED[name]
    with socket.create_connection((emulator.host, PRIMARY), timeout=LONGEST_S) as listener:
        found = log_of(emulator, source)
        assert "compile error" in found, found
        assert sentence in found, found
        listener.settimeout(1.0)
        data = b""
        while sentence.encode() not in data:
            data += listener.recv(65536)


@pytest.mark.parametrize("name", STOPPED)
def test_a_program_that_takes_too_much_is_stopped(name: str, emulator: Emulator) -> None:
    source, sentences = STOPPED[name]
    found = log_of(emulator, source)
    assert any(sentence in found for sentence in sentences.split("|")), found
    assert "program stopped" in found or name == "sockets without end", found


def test_a_popup_without_a_text_as_title_is_shown(emulator: Emulator) -> None:
    with socket.create_connection((emulator.host, PRIMARY), timeout=LONGEST_S):
        assert "popup" in log_of(emulator, body('popup("text", title=5)', 'popup([1], title=[2, "x"])', "sync()"))


def test_motions_beyond_all_numbers_are_protective_stops(emulator: Emulator) -> None:
    huge = "set_tcp(p[1e300, 1e300, 1e300, 0, 0, 0])"
    for motion in ("speedl([1e300, 0, 0, 0, 0, 1e300], 1e300, 1)", "movel(p[1e300, 0, 0, 0, 0, 0])", "stopl(1e-300)"):
        found = log_of(emulator, body(huge, "speedj([0.1, 0, 0, 0, 0, 0], 1, 0.01)", motion, "sleep(1)"))
        assert "protective stop" in found or "runtime error" in found or "stopl" in motion, found


NONSENSE = (
    b"[" * 200_000,
    b'{"a":' * 100_000,
    b"\xff\xfe\x00",
    b"null",
    b'{"fault": "clock_skew", "ppm": NaN}',
    b'{"fault": "clock_skew", "ppm": -9e8}',
    b'{"fault": "timestamp_jump", "seconds": 1e300}',
    b'{"fault": "set_q", "q": [NaN, 0, 0, 0, 0, 0]}',
    b'{"fault": "set_digital_out", "n": -1}',
    b'{"fault": "set_digital_out", "n": 1e9}',
    b'{"fault": "corrupt", "n": Infinity}',
    b'{"fault": "drop", "kind": "rtde", "index": {}}',
    b'{"do": "set_payload", "mass": 1, "cog": [1, 2]}',
    b'{"do": "external_control", "port": 1e9}',
    b'{"fault": "speed_scaling", "value": 1' + b"0" * 5000 + b"}",
    b'{"fault": "replace_program", "script": "def a():\\n  break\\nend\\n"}',
    b'{"check": "output_after", "fault_time": 0, "output": -1}',
    b'{"check": "at_rest_after", "fault_time": "x"}',
)


@pytest.mark.parametrize("line", NONSENSE, ids=lambda line: repr(line[:50]))
def test_nonsense_on_the_control_channel_is_answered(line: bytes, emulator: Emulator) -> None:
    with (
        socket.create_connection((emulator.host, emulator.control_port), timeout=LONGEST_S) as wire,
        wire.makefile("rb") as answers,
    ):
        wire.sendall(line + b"\n")
        answer = json.loads(answers.readline())
    assert not answer["ok"] or b"-9e8" in line
    frame = emulator.state()["frame"]
    time.sleep(0.05)
    assert emulator.state()["frame"] > frame
    emulator.do("recover")


def test_a_line_without_end_closes_its_own_connection_only(emulator: Emulator) -> None:
    def write_on(wire: socket.socket) -> None:
        for _ in range(100):
            wire.sendall(b"x" * 65536)
            time.sleep(0.002)

    with (
        socket.create_connection((emulator.host, emulator.control_port), timeout=LONGEST_S) as wire,
        pytest.raises(OSError, match=r"reset|Broken pipe"),
    ):
        write_on(wire)
    assert emulator.state()["frame"] > 0


def test_400_idle_connections_do_not_end_the_emulator(emulator: Emulator) -> None:
    wires = [socket.create_connection((emulator.host, PRIMARY), timeout=LONGEST_S) for _ in range(400)]
    frame = emulator.state()["frame"]
    time.sleep(0.05)
    assert emulator.state()["frame"] > frame
    for wire in wires:
        wire.close()


def mutants(emulator: Emulator, count: int, seed: int) -> tuple[Counter[str], float]:
    """How many mutated programs were started or refused, and the longest time that one of them took."""
    found: Counter[str] = Counter()
    longest = 0.0
    for _, source in zip(range(count), programs(seed), strict=False):
        try:
            state = sent(emulator, source, REAL_TIME)
        except Exception:
            sys.stderr.write(f"--- seed {seed}, after {sum(found.values())} programs:\n{source}\n")
            raise
        found["started" if state["started"] else "refused"] += 1
        longest = max(longest, float(state["took"]))
    return found, longest


def test_mutated_programs_neither_end_nor_stop_the_emulator(emulator: Emulator) -> None:
    found, longest = mutants(emulator, 500, seed=42)
    assert sum(found.values()) == 500
    assert found["started"] > 100
    assert longest < LONGEST_S
    assert emulator.process.poll() is None


if __name__ == "__main__":
    with emulator_process() as made:
        asked, first = int(sys.argv[1]), int(sys.argv[2])
        begun = time.monotonic()
        counts, slowest = mutants(made, asked, first)
        sys.stdout.write(
            f"{asked} programs, seed {first}: {dict(counts)}, slowest {slowest:.2f} s, "
            f"{time.monotonic() - begun:.0f} s; still running: {made.process.poll() is None}\n"
        )
