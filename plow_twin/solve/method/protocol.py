"""The contract of a method: a module that can lay out a step of the motion.

`solve.step` asks the methods in the order of its `METHODS` until one takes the step. Rules for `lay_out`:

1. It gets the state at `state.step_start` with `state.alpha, state.beta = 1, 0`; in `w.wrench` the load there that is
   linear in time, value and slope; in `w.per_pair` the contributions of the pairs; in `penetrating` whether any pair is
   inside its wall; in `span` the longest step wanted, in s.
2. It returns True when it has laid out the step, False to leave it to the next method. The last method, the Taylor
   series, returns False only where the motion is not finite.
3. With True it has written
   - up to `state.order` the series of state and penetration to `w.series`, `w.penetration`, and, while `penetrating`,
     those of rate and force to `w.rate`, `w.force`; a method without series writes the numbers that
     `dense_output.evaluate` needs;
   - the map of the series' variable sigma to time to `state.alpha`, `state.beta`;
   - to `state.sigma_end` the sigma up to which all of them meet the tolerance;
   - to `state.ends_at_stop` 1 where the step covers the whole of `span`, otherwise 0;
   - its own flag, if it has one (`in_flight`, `at_rest`).
4. With False it has written nothing but these fields, its own fields and scratch space.
5. It moves neither the state, its time and modes nor the totals: an event may end the step sooner, and
   `loop.lay_out_again` repeats the step after a restore. Rest alone moves the head, by a distance that it has proved to
   be below a thousandth of the tolerance.
6. It adds its evaluations of the equations of motion to `state.evaluations`.
7. What a scene does not need is not compiled: `own` returns None, or a tuple whose items are None, and a branch on an
   argument that is None is left out.
"""

from __future__ import annotations

from typing import Any, Protocol

from plow_twin.solve.state import Params, Parts, State, Work


class Method(Protocol):
    """A module with these two compiled functions; the rules of `lay_out` are those of this module's docstring."""

    def own(self, parts: Parts) -> Any:
        """Return the parts of a scene that the method is compiled for, None for a part that the scene lacks."""

    def lay_out(self, p: Params, parts: Parts, own: Any, state: State, w: Work, span: float, penetrating: bool) -> bool:
        """Lay out the next step, at most `span` s long; return False to leave it to the next method."""
