"""Decorator that compiles a loop with Numba on its first call and caches the machine code on disk."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(*, any_order: bool = False) -> Callable[[F], F]:
    """Compile a function to machine code; ``any_order`` allows sums in any order and assumes no NaN (fastmath).

    The code is kept beside its module, else in the user's cache; where neither may be written, every process compiles
    it anew, some seconds each.
    """

    def to_code(loop: F) -> F:
        options: dict[str, Any] = {"nogil": True, "fastmath": any_order, "error_model": "numpy"}
        try:
            return numba.njit(loop, cache=True, **options)  # type: ignore[no-any-return]
        except RuntimeError:  # no place for the cache
            return numba.njit(loop, **options)  # type: ignore[no-any-return]

    return to_code
