"""Numbers and shapes of arms, flanges, scanners, profilers, the welding tool, workpieces and scenarios."""

import importlib
import sys
from collections.abc import Callable
from functools import cache
from typing import Any


@cache
def _homes(package: str) -> dict[str, tuple[str, str]]:
    """Return the module, and the name in it, of each name that the package's file imports."""
    import ast

    loader: Any = sys.modules[package].__loader__
    lines = [node for node in ast.walk(ast.parse(loader.get_source(package))) if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: (str(line.module), alias.name) for line in lines for alias in line.names}


def exported(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Make the `__getattr__` and `__dir__` of a package whose imports are under TYPE_CHECKING.

    A type checker reads these imports. At run time the first use of a name in `__all__` imports its module.

    Raises:
        AttributeError: by `__getattr__`, for any other name.
    """
    module = sys.modules[package]

    def load(name: str) -> object:
        if name not in module.__all__:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        home, own = _homes(package)[name]
        found = getattr(importlib.import_module(home), own)
        setattr(module, name, found)
        return found

    return load, lambda: sorted({*vars(module), *module.__all__})
