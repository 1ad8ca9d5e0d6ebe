"""Sampled linear loops event by event, in 50 digits: between events by the Taylor series of the state.

x' = A x + B v, where v are the inputs of the plant: plans, what discrete blocks hold, and both of them some time ago.
"""

from bisect import bisect_right
from fractions import Fraction

import mpmath as mp

mp.mp.dps = 50
NEAR = mp.mpf("1e-11")
"""Events that are closer are one."""


def exact(number):
    """Decimal fraction that a float stands for, in 50 digits."""
    simple = Fraction(number).limit_denominator(10**7)
    simple = simple if abs(float(simple) - number) <= 1e-15 * abs(number) else Fraction(number)
    return mp.mpf(simple.numerator) / simple.denominator


class Plan:
    """Polynomials between breaks, by their derivatives."""

    def __init__(self, breaks, polynomials):
        """`polynomials`: coefficients, lowest power first, of the time since the break before; constant outside."""
        self.breaks = [mp.mpf(b) for b in breaks]
        self.polynomials = [[mp.mpf(c) for c in own] for own in polynomials]

    def jet(self, t, order=8):
        """Derivatives at t+."""
        k = bisect_right([b - NEAR for b in self.breaks], t) - 1
        if k < 0:
            return [self.polynomials[0][0]] + [mp.mpf(0)] * order
        last = k >= len(self.polynomials)
        k = min(k, len(self.polynomials) - 1)
        s = (self.breaks[-1] if last else t) - self.breaks[k]
        own = self.polynomials[k]
        found = [
            sum((mp.ff(i, n) * own[i] * s ** (i - n) for i in range(n, len(own))), mp.mpf(0)) for n in range(order + 1)
        ]
        return found[:1] + [mp.mpf(0)] * order if last else found


def smooth(first, last, size):
    """Rest to rest by s^3 (10 - 15 s + 6 s^2)."""
    first, duration = exact(first), exact(last) - exact(first)
    terms = [0, 0, 0, 10 / duration**3, -15 / duration**4, 6 / duration**5]
    return Plan([first, first + duration], [[size * c for c in terms]])


class Held:
    """What a discrete block with one output holds: xi+ = a xi + b u, h = c xi + d u."""

    def __init__(self, period, offset, a, b, c, d, inputs):
        """`inputs`: function of (x, read) for u, where read(signal, delay) is a signal's value at that time."""
        self.period, self.offset, self.inputs = exact(period), exact(offset), inputs
        self.a, self.b, self.c, self.d = (mp.matrix(m) if len(m) else mp.zeros(0) for m in (a, b, c, d))
        self.xi, self.past = mp.zeros(len(a), 1), []

    def at(self, t):
        """Value held at t, 0 before the first sample."""
        k = bisect_right([moment - NEAR for moment, _ in self.past], t) - 1
        return self.past[k][1] if k >= 0 else mp.mpf(0)


def run(a, b, c, drives, blocks, plans, state, times):
    """States of the plant and held values at times, right limits.

    `drives`: for each input of the plant a list of (signal, delay); signal a Plan, or the number of a block.
    `blocks`: Held; those that are due are sampled in this order.
    """
    a, b, state, times = mp.matrix(a), mp.matrix(b), mp.matrix(state), [mp.mpf(float(t)) for t in times]
    delays = {exact(delay) for drive in drives for _, delay in drive}
    events = {mp.mpf(0), *times}
    for plan in plans:
        events |= {moment + delay for moment in plan.breaks for delay in delays}
    due = {}
    for k, block in enumerate(blocks):
        moment = block.offset
        while moment <= times[-1] + NEAR:
            due.setdefault(mp.nstr(moment, 25), (moment, []))[1].append(k)
            events |= {moment + delay for delay in delays}
            moment += block.period
    events |= {moment for moment, _ in due.values()}
    marks = []
    for moment in sorted(t for t in events if 0 <= t <= times[-1] + NEAR):
        if not marks or moment - marks[-1] > NEAR:
            marks.append(moment)
    rows = []
    for k, t in enumerate(marks):
        for moment, chosen in due.values():
            if abs(moment - t) <= NEAR:
                for i in chosen:
                    block = blocks[i]

                    def read(signal, delay=0, now=t):
                        past = now - exact(delay)
                        if isinstance(signal, Plan):
                            return signal.jet(past, 0)[0] if past >= -NEAR else mp.mpf(0)
                        return blocks[signal].at(past)

                    u = mp.matrix(block.inputs(state, read))
                    h = (block.c * block.xi if len(block.xi) else mp.zeros(1)) + block.d * u
                    block.xi = block.a * block.xi + block.b * u if len(block.xi) else block.xi
                    block.past.append((t, h[0]))
        rows += [
            (float(s), [float(x) for x in state] + [float(block.at(t)) for block in blocks])
            for s in times
            if abs(s - t) <= NEAR
        ]
        if k + 1 == len(marks):
            break
        state = _moved(a, b, drives, blocks, state, t, marks[k + 1])
    return [[row[1][i] for row in rows] for i in range(len(rows[0][1]))]


def _moved(a, b, drives, blocks, state, t, end):
    """State at a later time; the inputs are polynomials in between. In parts that are short for the fastest mode."""
    size = max(sum(abs(entry) for entry in a[i, :]) for i in range(a.rows))
    parts = int(mp.ceil(size * (end - t) / 4)) or 1
    length = (end - t) / parts
    for part in range(parts):
        now = t + part * length
        jets = []
        for drive in drives:
            jet = [mp.mpf(0)] * 8
            for signal, delay in drive:
                past = now - exact(delay)
                if isinstance(signal, Plan):
                    own = signal.jet(past, 7) if past >= -NEAR else [mp.mpf(0)] * 8
                else:
                    own = [blocks[signal].at(past)]
                jet = [x + (own[i] if i < len(own) else 0) for i, x in enumerate(jet)]
            jets.append(jet)
        term, total, k = state, state, 0  # term: the k-th derivative of the state
        factor = mp.mpf(1)
        while k < 9 or max(abs(x) for x in term) * factor > mp.mpf("1e-52"):
            w = mp.matrix([jet[k] if k < 8 else mp.mpf(0) for jet in jets])
            term = a * term + b * w
            k += 1
            factor = factor * length / k
            total = total + term * factor
        state = total
    return state
