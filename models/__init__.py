"""Numbers and shapes of arms, flanges, scanners, profilers, the welding tool, workpieces and scenarios."""

import importlib
import sys
from collections.abc import Callable
from functools import cache
from typing import Any


@cache
def _homes(package: str) -> dict[str, str]:
    """Return the module of each name that the package's file imports under TYPE_CHECKING."""
    import ast

    loader: Any = sys.modules[package].__loader__
    checked = next(node for node in ast.parse(loader.get_source(package)).body if isinstance(node, ast.If))
    lines = [node for node in checked.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(line.module) for line in lines for alias in line.names}


def exported(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Make the `__getattr__` and `__dir__` of a package whose imports are under TYPE_CHECKING.

    A type checker reads these imports. At run time the first use of a name imports its module; `__all__` has them all.

    Raises:
        AttributeError: by `__getattr__`, for any other name.
    """
    module = sys.modules[package]

    def load(name: str) -> object:
        homes = _homes(package)
        if name == "__all__":
            return sorted(homes)
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        found = getattr(importlib.import_module(homes[name]), name)
        setattr(module, name, found)
        return found

    return load, lambda: sorted({*vars(module), *_homes(package)})
