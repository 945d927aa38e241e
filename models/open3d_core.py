"""Open3D, imported without the packages that it plots with: they take as long to import as its own code, and nothing here plots."""

import importlib
import sys
from types import ModuleType
from typing import Any

_PLOTTING = ("plotly", "plotly.graph_objects", "dash")


class _Later:
    """Something of a package that is imported when it is used for the first time."""

    def __init__(self, module: str, name: str) -> None:
        self._of = module, name

    def _found(self) -> Any:
        module, name = self._of
        return getattr(importlib.import_module(module), name)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._found(), name)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self._found()(*arguments, **named)


class _Stub(ModuleType):
    """Stands for a package while Open3D is imported."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Later(self.__name__, name)


def _imported() -> Any:
    stubs = {name: _Stub(name) for name in _PLOTTING if name not in sys.modules}
    sys.modules.update(stubs)
    try:
        return importlib.import_module("open3d")
    finally:
        for name in stubs:
            del sys.modules[name]


o3d = _imported()
