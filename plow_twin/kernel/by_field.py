"""Choice of a kernel at compile time by the fields of a record."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from plow_twin.errors import ArgumentError


def by_field(name: str, present: Callable[..., Any], absent: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function for kernels that calls `present` if its first argument has the field, and else `absent`.

    Parameters
    ----------
    name : str
        Name of the field.
    present, absent : callable
        Compiled functions with the same parameters. The first parameter is a record.
    """

    def choose(p: Any, *more: Any) -> Any:
        raise ArgumentError(f"by_field({name!r}): called from Python, expected a call from a kernel")

    def implementation(p, *more):  # type: ignore[no-untyped-def]
        return present if name in p.fields else absent

    # strict=True would reject `choose`, whose signature differs from the chosen function's
    overload(choose, strict=False)(implementation)
    return choose
