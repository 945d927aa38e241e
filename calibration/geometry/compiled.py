"""Loops that no array operation can join, compiled by Numba on their first call and kept on disk for all later ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(*, any_order: bool = False) -> Callable[[F], F]:
    """Makes a function machine code; ``any_order`` lets its sums be taken in any order, and then it knows no NaN.

    The code is kept beside its module, else in the user's cache; where neither may be written, every process compiles it
    anew, some seconds each.
    """

    def to_code(loop: F) -> F:
        try:
            return numba.njit(loop, cache=True, nogil=True, fastmath=any_order, error_model="numpy")  # type: ignore[no-any-return]
        except RuntimeError:  # no place for the cache
            return numba.njit(loop, nogil=True, fastmath=any_order, error_model="numpy")  # type: ignore[no-any-return]

    return to_code
