"""Ways to lay out a step: free flight, rest, implicit, Taylor series.

A method is one function, asked in the order above by `solve.step` until one takes the step:

    lay_out(p, parts, its own parts ..., state, w, span, penetrating) -> bool

1. Its own parts are those that make numba leave it out of a scene without them: `None` in their place, and it returns
   False from an empty body.
2. It gets: the state at `state.step_start`, `state.alpha, state.beta = 1, 0`, the load there that is linear in time in
   `w.wrench` (value and slope), what each pair contributes in `w.per_pair`, whether any pair is inside its wall in
   `penetrating`, and `span`, the longest step wanted, in s.
3. It returns True when it has laid out the step, False when another method should. Only the last one, the Taylor
   series, has no other to leave it to: there False says that the motion is not finite.
4. With True it has written: the series of state and penetration, and while `penetrating` those of rate and force, to
   `w.series`, `w.penetration`, `w.rate`, `w.force`, up to `state.order`; or what `dense_output.evaluate` needs in their
   place. The map of the series' variable to time to `state.alpha`, `state.beta`. To `state.sigma_end` how far all
   that meets the tolerance, and to `state.ends_at_stop` whether that is the whole of `span`. Its own flag, if it has
   one (`in_flight`, `at_rest`).
5. It does not move the state, its time or its modes, nor the totals: events may end the step sooner, and
   `lay_out_again` repeats it after a restore. Rest alone moves the head, by what it has proved to be below a thousandth
   of the tolerance.
6. It counts its work in `state.evaluations`.
7. With False it has left alone everything but its own fields and scratch space.
"""
