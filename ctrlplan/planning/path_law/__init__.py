"""Time law of minimum duration on the path of a plan.

With the squared rate b(s) = (ds/dt)^2 of the path parameter s, limits of
velocities, p' sqrt(b), and accelerations, p'' b + p' b'/2, are linear in b and b',
and the duration, the integral of 1/sqrt(b), is convex. b is a quadratic spline. The plan is
divided at its stops (`spans`) into cells (`grid`), limits are inequalities for each
cell (`rows`), a feasible law is found by two passes (`sweep`), and the fastest one
by an interior-point method (`interior_point`); cells that are not at a limit are
divided (`law`). With limits of the jerk b is a quartic spline, and the problem a
sequence of convex ones (`jerk`); with limits of other signals it is a sequence of
linearised ones (`signals`).
"""

from ctrlplan.planning.path_law.jerk import fastest_smooth_law
from ctrlplan.planning.path_law.law import fastest_law
from ctrlplan.planning.path_law.spans import Rates, corner_times

__all__ = ["Rates", "corner_times", "fastest_law", "fastest_smooth_law"]
