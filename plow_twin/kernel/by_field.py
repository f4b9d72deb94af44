"""Compiled functions of a record that are chosen by whether its type has a field: the other choice is not compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from plow_twin.errors import ArgumentError


def by_field(name: str, present: Callable[..., Any], absent: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of a record p for use in kernels: `present` for types with the field, `absent` for the others.

    Parameters
    ----------
    name : str
        The field.
    present, absent : callable
        Functions that numba compiles, of p and of the same further arguments.
    """

    def choose(p: Any, *more: Any) -> Any:
        raise ArgumentError(f"by_field({name!r}): called from Python, expected a call from a kernel")

    def implementation(p, *more):  # type: ignore[no-untyped-def]
        return present if name in p.fields else absent

    # strict would compare this signature with the chosen one
    overload(choose, strict=False)(implementation)
    return choose
