"""Interface of a method. A method is a module with a function `lay_out`, which computes a step of the motion.

`solve.step` calls the methods in the order of its `METHODS`, until a method has computed the step. Rules for `lay_out`:

1. The inputs of `lay_out` are:
   - the state at `state.step_start` with `state.alpha, state.beta = 1, 0`;
   - the value and slope of the linear load at this time, in `w.wrench`;
   - the factors of the pairs in the series, in `w.per_pair`;
   - `penetrating`, which states whether any pair penetrates;
   - `span`, the longest admissible step in s.
2. `lay_out` returns True if it has computed the step. It returns False to leave the step to the next method. The last
   method, the Taylor series, returns False only if the motion is not finite.
3. Before `lay_out` returns True, it writes:
   - the series of state and penetration up to `state.order`, to `w.series` and `w.penetration`;
   - the series of rate and force, to `w.rate` and `w.force`, if `penetrating` is true;
   - the coefficients of the time as a function of the series variable sigma, to `state.alpha` and `state.beta`;
   - the sigma up to which all these series meet the tolerance, to `state.sigma_end`;
   - 1 to `state.ends_at_stop` if the step covers the whole of `span`, and 0 otherwise;
   - the flag of the method (`in_flight`, `at_rest`), if it has a flag.
   A method without series writes the data that `dense_output.evaluate` needs instead.
4. Before `lay_out` returns False, it may change only the fields of rule 3, fields of the method, and scratch space.
5. `lay_out` does not change the head's position, time, modes or totals, because an event may shorten the step, and
   because `loop.lay_out_again` repeats the step after a snapshot is restored. The method for rest is an
   exception. It moves the head by less than a thousandth of the tolerance.
6. `lay_out` adds its evaluations of the equations of motion to `state.evaluations`.
7. Code that a scene does not need is not compiled. To this end, `own` returns None, or a tuple that contains None.
   Numba omits branches on an argument that is None.
"""

from __future__ import annotations

from typing import Any, Protocol

from plow_twin.solve.state import Params, Parts, State, Work


class Method(Protocol):
    """A module with two compiled functions. The docstring of this module contains the rules for `lay_out`."""

    def own(self, parts: Parts) -> Any:
        """Return the parts of a scene for which the method is compiled, with None for each missing part."""

    def lay_out(self, p: Params, parts: Parts, own: Any, state: State, w: Work, span: float, penetrating: bool) -> bool:
        """Compute the next step, at most `span` s long. Return False to leave the step to the next method."""
