"""A parking manoeuvre into a bay at 90 degrees to the lane, and what a car does along it in closed form."""

import numpy as np

import ctrlplan as cp

WHEELBASE = 3.0
"""Of the cars of `flat_plants`."""


def curve(*points, labels=None):
    """Curve through (s, x jet, y jet), one polynomial."""
    return cp.PolySpline([cp.Waypoint.from_jets(s, x=x, y=y) for s, x, y in points], labels=labels)


def law(duration, last=1.0, first=0.0):
    """From rest to rest without a jump of the jerk."""
    return cp.PolySpline([cp.Waypoint(0.0, first, 0, 0, 0), cp.Waypoint(duration, last, 0, 0, 0)])


FORWARD = curve((0.0, [0, 8, 0, 0], [0, 0, 0, 0]), (1.0, [6, 5, 0, 0], [2, 5, 0, 0]))
BACKWARD = curve((0.0, [6, -5, 0, 0], [2, -5, 0, 0]), (1.0, [2, 0, 0, 0], [-4, -9, 0, 0]))
"""Straight at their ends, where the steering angle is zero."""


def parking(durations=(5.0, 6.0)):
    """Forward and to the left, then backward into the bay."""
    return cp.PathPlan([FORWARD, BACKWARD], [1, -1], [law(duration) for duration in durations])


def expected(plan, t):
    """Heading, speed, steering angle and steering rate from s(t), p(s) and the curvature, segment by segment.

    With z = dp/ds as a complex number, curvature by parameter is Im(z' conj z) / |z|^3.
    """
    t = np.asarray(t)
    theta, speed, delta, rate = np.empty((4, t.size))
    number = np.clip(np.searchsorted(plan.stops, t, side="right") - 1, 0, len(plan.segments) - 1)
    for i, (curve, law, direction) in enumerate(zip(plan.segments, plan.laws, plan.directions, strict=True)):
        k = np.flatnonzero(number == i)
        s, ds = law.jet(t[k], 1)[:, 0]
        x, y = curve.jet(s, 3).transpose(1, 0, 2)
        z, dz, ddz = x[1:] + 1j * y[1:]
        theta[k] = np.angle(direction * z)
        speed[k] = direction * ds * abs(z)
        curvature = direction * (dz * z.conjugate()).imag / abs(z) ** 3
        delta[k] = np.arctan(WHEELBASE * curvature)
        growth = (ddz * z.conjugate()).imag / abs(z) ** 3
        growth -= 3.0 * (dz * z.conjugate()).imag * (dz * z.conjugate()).real / abs(z) ** 5
        rate[k] = WHEELBASE * direction * growth * ds / (1.0 + (WHEELBASE * curvature) ** 2)
    return theta, speed, delta, rate


def by_hand(steering="two arguments", **options):
    """The car of the literature, rear axle as flat output."""

    def reverse(flag, params=None):
        (x, vx, ax), (y, vy, ay) = flag
        across = vx * ay - vy * ax
        with np.errstate(divide="ignore", invalid="ignore"):
            if steering == "two arguments":
                delta = np.arctan2(WHEELBASE * across, np.hypot(vx, vy) ** 3)
            else:
                delta = np.arctan(WHEELBASE * across / np.hypot(vx, vy) ** 3)
        return np.stack([x, y, np.arctan2(vy, vx)]), np.stack([np.hypot(vx, vy), delta])

    def forward(x, u, params=None):
        c, s, turn = np.cos(x[2]), np.sin(x[2]), u[0] * np.tan(u[1]) / WHEELBASE
        return [np.array([x[0], u[0] * c, -u[0] * turn * s]), np.array([x[1], u[0] * s, u[0] * turn * c])]

    def rates(t, x, u, params=None):
        return np.array([u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[0] * np.tan(u[1]) / WHEELBASE])

    return cp.FlatSystem(
        forward,
        reverse,
        rates,
        lambda t, x, u, params: x,
        **{
            "orders": (2, 2),
            "flat_labels": ("x", "y"),
            "states": ["x", "y", "th"],
            "inputs": ["v", "delta"],
            "outputs": ["x", "y", "th"],
            "name": "by_hand",
            **options,
        },
    )
