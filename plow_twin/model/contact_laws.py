"""Contact laws, each with its equation and its source.

Most laws have the form F = K d^n (1 + lambda d'), where d is the penetration and its rate d' is positive inward. These
laws differ in the damping number D = lambda v0 that they derive from the restitution e. v0 is the speed at first touch.
The additive laws add C d' to K d^n. C acts fully from the first touch (Kelvin-Voigt), or increases over a ramp.

A new law is an entry of `_LAWS`, or a call of `add_law` from outside the package.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from keyword import iskeyword
from numbers import Real
from types import MappingProxyType
from typing import Final

from plow_twin.errors import ArgumentError

#: Value of 1 - e below which D is computed from the first two terms of its series, because rounding dominates the
#: residual.
_NEARLY_ELASTIC: Final = 1e-5
#: Upper bound of D = lambda v0, which some laws make infinite at a restitution of 0.
DAMPING_NUMBER_CAP: Final = 1e3


def exact_damping_number(restitution: float) -> float:
    """Return the damping number D for which an impact has exactly the restitution e.

    D solves D (1 + e) = ln((1 + D) / (1 - D e)), the first integral of a free impact under F = K d^n (1 + lambda d');
    cf. Hunt and Crossley, J. Appl. Mech. 42 (1975) 440.
    """
    if restitution >= 1.0:
        return 0.0
    if restitution <= 0.0:
        return math.inf
    lost = 1.0 - restitution
    if lost < _NEARLY_ELASTIC:
        return 1.5 * lost * (1.0 + lost)

    def residual(damping: float) -> float:
        # division by D removes the trivial root D = 0
        return (1.0 + restitution) - (math.log1p(damping) - math.log1p(-damping * restitution)) / damping

    # the root is less than 1/e, and about 3 (1 - e) / 2 near e = 1
    lower, upper = 0.5 * lost, 1.0 / restitution
    while upper * restitution >= 1.0:
        upper = math.nextafter(upper, 0.0)
    if residual(upper) > 0.0:
        return upper
    from scipy.optimize import brentq  # this import takes 0.25 s, which only scenes with this law need

    root: float = brentq(residual, lower, upper, xtol=1e-300, rtol=1e-15)
    return root


@dataclass(frozen=True)
class ContactLaw:
    """Options of one contact law, and the damping that the law derives from a restitution.

    Attributes
    ----------
    title : str
        Usual name of the law.
    source : str
        Equation of the law, and its publication.
    number_of : callable, optional
        Function of the restitution e that returns the damping number D = lambda v0 [1]. Without it, a scene cannot
        give a restitution for this law.
    takes_damping : bool
        Whether a scene can give the damping directly.
    exponent : float, optional
        The only admissible exponent; None if every exponent is admissible.
    additive : bool
        True for a damping term C d' that is added to K d^n, False for a damping factor of K d^n.
    ramped : bool
        Whether C increases from 0 to its full value over the penetration `ramp_m`.

    Raises
    ------
    ArgumentError
        The options contradict each other. A ramp requires additive damping. Additive damping excludes a restitution.
        An additive law without a ramp requires the exponent 1.
    """

    title: str
    source: str
    number_of: Callable[[float], float] | None = None
    takes_damping: bool = True
    exponent: float | None = None
    additive: bool = False
    ramped: bool = False

    def __post_init__(self) -> None:
        problems = []
        if self.ramped and not self.additive:
            problems.append("ramped=True: expected additive=True, since the ramp acts on C")
        if self.additive and self.number_of is not None:
            problems.append("number_of: expected None, since the damping of a law with additive=True is C")
        if self.additive and not self.ramped and self.exponent != 1.0:
            problems.append(f"exponent: got {self.exponent!r}, expected 1 for an additive law without a ramp")
        if problems:
            raise ArgumentError(f"contact law {self.title!r}: " + "; ".join(problems))

    @property
    def takes_restitution(self) -> bool:
        """Whether a scene can give a restitution for this law."""
        return self.number_of is not None

    def damping_number(self, restitution: float) -> float:
        """Return the damping number D = lambda v0 [1] for a nominal restitution, at most `DAMPING_NUMBER_CAP`.

        Parameters
        ----------
        restitution : float
            Coefficient of restitution [1], 0 to 1.

        Raises
        ------
        ArgumentError
            The law has no damping number, or D(e) is not a number >= 0.
        """
        if self.number_of is None:
            raise ArgumentError(f"law: got {self.title}, expected a law that takes a restitution")
        try:
            number: object = self.number_of(restitution)
        except ZeroDivisionError:
            return DAMPING_NUMBER_CAP
        except Exception as error:  # the law may be the user's
            reason = f"{type(error).__name__}: {error}"
            raise ArgumentError(f"{self.title}: D({restitution:g}): got {reason}, expected a number >= 0") from error
        if not isinstance(number, Real) or not float(number) >= 0.0:
            raise ArgumentError(f"{self.title}: D({restitution:g}): got {number!r}, expected a number >= 0")
        return min(float(number), DAMPING_NUMBER_CAP)


_LAWS: Final[dict[str, ContactLaw]] = {
    "exact_restitution": ContactLaw(
        "exact restitution",
        "D (1 + e) = ln((1 + D) / (1 - D e)); first integral of a free impact, cf. J. Appl. Mech. 42 (1975) 440",
        exact_damping_number,
        takes_damping=False,
    ),
    "kelvin_voigt": ContactLaw(
        "Kelvin-Voigt", "F = max(0, K d + C d'); Goldsmith, Impact, 1960", exponent=1.0, additive=True
    ),
    "hertz": ContactLaw("Hertz", "F = K d^n; Hertz, J. reine angew. Math. 92 (1881) 156", takes_damping=False),
    "hunt_crossley": ContactLaw(
        "Hunt-Crossley", "D = 3 (1 - e) / 2; J. Appl. Mech. 42 (1975) 440", lambda e: 1.5 * (1.0 - e)
    ),
    "herbert_mcwhannell": ContactLaw(
        "Herbert-McWhannell",
        "D = 6 (1 - e) / ((2 e - 1)^2 + 3); J. Eng. Ind. 99 (1977) 513",
        lambda e: 6.0 * (1.0 - e) / ((2.0 * e - 1.0) ** 2 + 3.0),
    ),
    "lee_wang": ContactLaw(
        "Lee-Wang", "D = 3 (1 - e) / 4; J. Mech. Transm. Autom. 105 (1983) 534", lambda e: 0.75 * (1.0 - e)
    ),
    "lankarani_nikravesh": ContactLaw(
        "Lankarani-Nikravesh", "D = 3 (1 - e^2) / 4; J. Mech. Des. 112 (1990) 369", lambda e: 0.75 * (1.0 - e * e)
    ),
    "gonthier": ContactLaw(
        "Gonthier et al.", "D = (1 - e^2) / e; Multibody Syst. Dyn. 11 (2004) 209", lambda e: (1.0 - e * e) / e
    ),
    "zhiying_qishao": ContactLaw(
        "Zhiying-Qishao",
        "D = 3 (1 - e^2) exp(2 (1 - e)) / 4; J. Mech. Strength 28 (2006)",
        lambda e: 0.75 * (1.0 - e * e) * math.exp(2.0 * (1.0 - e)),
    ),
    "flores": ContactLaw(
        "Flores et al.", "D = 8 (1 - e) / (5 e); Multibody Syst. Dyn. 25 (2011) 357", lambda e: 1.6 * (1.0 - e) / e
    ),
    "hu_guo": ContactLaw(
        "Hu-Guo", "D = 3 (1 - e) / (2 e); Multibody Syst. Dyn. 35 (2015) 303", lambda e: 1.5 * (1.0 - e) / e
    ),
    "ramped_damping": ContactLaw(
        "ramped damping",
        "F = max(0, K d^n + C u^2 (3 - 2 u) d'), u = min(d / ramp, 1); IMPACT of MSC Adams (STEP), RecurDyn alike",
        additive=True,
        ramped=True,
    ),
}
LAWS: Final[Mapping[str, ContactLaw]] = MappingProxyType(_LAWS)


def add_law(name: str, law: ContactLaw) -> None:
    """Add a contact law under a name that scenes can use. The solver runs it as fast as the built-in laws.

    The law is added to this process only. The option `--laws` adds the law to commands and to their child processes.

    Parameters
    ----------
    name : str
        Name of the law in scenes: letters, digits and _.
    law : ContactLaw

    Raises
    ------
    ArgumentError
        The name is already used, is a keyword of Python, or contains a character other than letters, digits and _; or
        `law` is not a `ContactLaw`.
    """
    if not isinstance(law, ContactLaw):
        raise ArgumentError(f"contact law {name!r}: got {law!r}, expected a ContactLaw")
    if name in LAWS or not (name.isidentifier() and name.isascii()) or iskeyword(name):
        raise ArgumentError(f"contact law: got {name!r}, expected a new name of letters, digits and _")
    _LAWS[name] = law
