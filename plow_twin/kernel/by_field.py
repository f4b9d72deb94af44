"""Compiled functions of a record that are chosen by whether its type has a field: the other choice is not compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from plow_twin.errors import ArgumentError


def by_field(name: str, present: Callable[[Any], Any], absent: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a function of a record p for use in kernels: `present` for types with the field, `absent` for the others.

    Parameters
    ----------
    name : str
        The field.
    present, absent : callable
        Functions of one argument p that numba compiles.
    """

    def choose(p: Any) -> Any:
        raise ArgumentError(f"by_field({name!r}): called from Python, expected a call from a kernel")

    def implementation(p):  # type: ignore[no-untyped-def]  # numba compares this signature with the chosen one
        return present if name in p.fields else absent

    overload(choose)(implementation)
    return choose
