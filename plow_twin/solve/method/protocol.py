"""The contract of a method: a module that can lay out a step of the motion.

`solve.step` calls the methods in the order of its `METHODS` until a method lays out the step. Rules for `lay_out`:

1. Its input is the state at `state.step_start` with `state.alpha, state.beta = 1, 0`; in `w.wrench` the value and slope
   of the linear load at this time; in `w.per_pair` the pairs' factors in the series; in `penetrating` whether any pair
   is inside its wall; in `span` the longest step wanted, in s.
2. It returns True if it has laid out the step, and False to leave the step to the next method. The last method, the
   Taylor series, returns False only if the motion is not finite.
3. If it returns True, it has written
   - up to `state.order` the series of state and penetration to `w.series`, `w.penetration`, and, while `penetrating`,
     those of rate and force to `w.rate`, `w.force`; a method without series writes the numbers that
     `dense_output.evaluate` needs;
   - the map of the series' variable sigma to time to `state.alpha`, `state.beta`;
   - to `state.sigma_end` the sigma up to which all these series meet the tolerance;
   - to `state.ends_at_stop` 1 if the step covers the whole of `span`, otherwise 0;
   - the method's flag, if it has one (`in_flight`, `at_rest`).
4. If it returns False, it has changed only these fields, fields of the method itself and scratch space.
5. It does not change the motion's place, time, modes or totals, because an event may end the step sooner, and
   `loop.lay_out_again` repeats the step after a restore. Only rest moves the head, by a distance that is proved to be
   below a thousandth of the tolerance.
6. It adds its evaluations of the equations of motion to `state.evaluations`.
7. Code that a scene does not need is not compiled: `own` returns None, or a tuple with items that are None, and numba
   leaves out a branch on an argument that is None.
"""

from __future__ import annotations

from typing import Any, Protocol

from plow_twin.solve.state import Params, Parts, State, Work


class Method(Protocol):
    """A method is a module with two compiled functions; this module's docstring has the rules of `lay_out`."""

    def own(self, parts: Parts) -> Any:
        """Return the parts of a scene for which the method is compiled, with None for each part that it lacks."""

    def lay_out(self, p: Params, parts: Parts, own: Any, state: State, w: Work, span: float, penetrating: bool) -> bool:
        """Lay out the next step, at most `span` s long; return False to leave it to the next method."""
