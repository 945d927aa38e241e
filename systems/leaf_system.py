"""LeafSystem: Drake's, but what it declares does not keep it alive, so that a cell's memory is freed after its run."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import MethodType
from typing import TYPE_CHECKING, Any
from weakref import ref

from pydrake.systems.framework import LeafSystem as DrakeLeafSystem

# Their callbacks are stored in C++, where Python's garbage collector does not look.
DECLARATIONS = (
    "DeclareVectorOutputPort",
    "DeclareAbstractOutputPort",
    "DeclareInitializationPublishEvent",
    "DeclareInitializationDiscreteUpdateEvent",
    "DeclareInitializationUnrestrictedUpdateEvent",
    "DeclarePeriodicPublishEvent",
    "DeclarePeriodicDiscreteUpdateEvent",
    "DeclarePeriodicUnrestrictedUpdateEvent",
    "DeclarePerStepPublishEvent",
    "DeclarePerStepDiscreteUpdateEvent",
    "DeclarePerStepUnrestrictedUpdateEvent",
    "DeclareForcedPublishEvent",
    "DeclareForcedDiscreteUpdateEvent",
    "DeclareForcedUnrestrictedUpdateEvent",
)


def without_owner(callback: Any) -> Any:
    """Return the callback with a weak reference to the object whose method it is (a `partial` of a method too).

    Any other as it is.
    """
    if isinstance(callback, MethodType):
        return _of_a_reference(callback.__func__, ref(callback.__self__))
    if isinstance(callback, partial):
        return partial(without_owner(callback.func), *callback.args, **callback.keywords)
    return callback


def _of_a_reference(function: Callable[..., Any], owner: ref[Any]) -> Callable[..., Any]:
    def call(*arguments: Any, **named: Any) -> Any:
        return function(owner(), *arguments, **named)

    return call


def _metaclass() -> Any:
    """Return a metaclass whose classes keep their objects' attributes where pybind11 keeps them.

    Drake for Python 3.12 and later is bound by nanobind, whose metaclass has no subclasses and needs none.
    """
    drakes: Any = type(DrakeLeafSystem)
    if not drakes.__module__.startswith("pybind11"):
        return drakes
    return type(
        "OfCpp", (drakes,), {"__prepare__": classmethod(lambda cls, name, bases, /, **named: {"__slots__": ()})}
    )


class LeafSystem(DrakeLeafSystem, metaclass=_metaclass()):
    """A Drake LeafSystem that is freed with its Diagram.

    Two things keep others in memory for ever, with plants and renderers:

    - pydrake 1.51 stores a declared method in C++. It keeps the Python system alive, which keeps the C++ system alive,
      which keeps the method (Drake issues 22515, 23930 and 24162). Here C++ gets a function that knows its system by a
      weak reference; the Diagram keeps the system alive. A callback must be a method or a `functools.partial` of one:
      what a lambda captures stays captured.
    - With CPython 3.11 the attributes of a Python class that derives from one of pybind11 are counted twice by the
      garbage collector, which then never frees a cycle (pybind11 issue 4092), and each port is in a cycle with its
      system. The metaclass leaves them to pybind11: every derived class has empty `__slots__`, and takes attributes all
      the same.
    """


def _declare(name: str) -> Callable[..., Any]:
    drakes = getattr(DrakeLeafSystem, name)

    def declare(self: LeafSystem, *values: Any, **named: Any) -> Any:
        return drakes(self, *map(without_owner, values), **{key: without_owner(value) for key, value in named.items()})

    declare.__name__, declare.__doc__ = name, drakes.__doc__
    return declare


if not TYPE_CHECKING:
    for _name in DECLARATIONS:
        setattr(LeafSystem, _name, _declare(_name))
