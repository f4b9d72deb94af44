"""Reasons for the states of an estimate, as texts with physical quantities that can be converted to other units."""

from __future__ import annotations

from typing import Any, Final

#: Powers of length, mass and time in the unit of a quantity.
Dimension = tuple[int, int, int]

#: Dimensions of the quantities, by definition.
LENGTH: Final[Dimension] = (1, 0, 0)
TIME: Final[Dimension] = (0, 0, 1)
FREQUENCY: Final[Dimension] = (0, 0, -1)
SPEED: Final[Dimension] = (1, 0, -1)
FORCE: Final[Dimension] = (1, 1, -2)
NUMBER: Final[Dimension] = (0, 0, 0)


class Reason(str):
    """A text that contains physical quantities.

    Parameters
    ----------
    form : str
        Format string with one field for each quantity.
    *quantities : tuple of (float, Dimension)
        Value and dimension of each quantity.
    """

    form: str
    quantities: tuple[tuple[float, Dimension], ...]

    def __new__(cls, form: str, *quantities: tuple[float, Dimension]) -> Reason:
        """Write the quantities into the text."""
        reason = super().__new__(cls, form.format(*(value for value, _ in quantities)))
        reason.form, reason.quantities = form, quantities
        return reason

    def __getnewargs__(self) -> tuple[Any, ...]:
        """Return the arguments with which a copy is made."""
        return self.form, *self.quantities

    def after(self, beginning: str) -> Reason:
        """Return the text after another text without quantities."""
        return Reason(beginning.replace("{", "{{").replace("}", "}}") + self.form, *self.quantities)

    def in_si(self, length: float, mass: float, time: float) -> Reason:
        """Return the text converted to SI from given units of length [m], mass [kg] and time [s]."""
        return Reason(
            self.form,
            *(
                (value * length ** powers[0] * mass ** powers[1] * time ** powers[2], powers)
                for value, powers in self.quantities
            ),
        )
