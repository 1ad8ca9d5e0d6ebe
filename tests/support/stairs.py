"""Piecewise constant plans, to compare a stepper with `simulate`."""

import numpy as np

import ctrlplan as cp


class _Stairs(cp.Trajectory):
    """Values (naxes, nsteps), each held over a step that begins at one of the times (nsteps + 1,)."""

    values: np.ndarray

    def __init__(self, times, values, labels):
        self._set_fields(labels=tuple(labels), breakpoints=np.asarray(times, dtype=float), values=values)

    def segment_jet(self, segment, s, order):
        jet = np.zeros((order + 1, len(self.values), s.size))
        jet[0] = self.values[:, segment : segment + 1]
        return jet

    def map_time(self, origin, target, rate):
        return _Stairs(target + (self.breakpoints - origin) / rate, self.values, self.labels)

    def to_dict(self):
        return {"type": "_Stairs", "times": self.breakpoints, "values": self.values, "labels": self.labels}

    @classmethod
    def from_dict(cls, data):
        return cls(data["times"], data["values"], data["labels"])


def held(values, dt, labels, start=0.0):
    """Plan that holds the columns of values (naxes, nsteps) for dt each."""
    values = np.atleast_2d(values)
    return _Stairs([start + k * dt for k in range(values.shape[1] + 1)], values, labels)


def stepped(stepper, values):
    """Outputs before and after each step, and states, (.., nsteps) and (nstates, nsteps + 1)."""
    before, after, states = [], [], [stepper.state]
    for u in np.atleast_2d(values).T:
        before.append(stepper.outputs(u))
        after.append(stepper.step(u))
        states.append(stepper.state)
    return np.array(before).T, np.array(after).T, np.array(states).T
