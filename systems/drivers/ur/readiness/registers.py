"""Names of the input registers that the driver claims, and their ranges as text."""

# The command and its numbers, from register 0 or (upper registers) 24 on.
# Two more numbers are the set points of the power source, where they are wired.
INTEGERS, DOUBLES, SET_POINTS, UPPER_OFFSET = 1, 8, 2, 24


def register_names(offset: int, doubles: int = DOUBLES) -> list[str]:
    """The names, from a register on."""
    integers = [f"input_int_register_{i}" for i in range(offset, offset + INTEGERS)]
    return integers + [f"input_double_register_{i}" for i in range(offset, offset + doubles)]


def ranges(names: list[str]) -> str:
    """Register names as ranges, such as: int 24-31, double 24-41."""
    parts = []
    for kind in ("int", "double"):
        numbers = sorted(int(name.rpartition("_")[2]) for name in names if name.startswith(f"input_{kind}_"))
        runs: list[list[int]] = []
        for number in numbers:
            if runs and number == runs[-1][-1] + 1:
                runs[-1].append(number)
            else:
                runs.append([number])
        parts += [f"{kind} {run[0]}" + (f"-{run[-1]}" if len(run) > 1 else "") for run in runs]
    return ", ".join(parts)
