"""Differences of two responses to one call, and a more accurate response of python-control."""

from __future__ import annotations

import copy
import warnings
from functools import partial
from itertools import count

import control as ct
import numpy as np

AGREEMENT = 1e-6
"""Largest difference, relative to the range of each signal."""

ROUNDING = 1e-13
"""Largest difference relative to the largest signal of the call: rounding errors of signals that are constant."""

TIGHT = (
    {"method": "LSODA", "rtol": 1e-10},
    {"method": "DOP853", "rtol": 1e-12},
    {"method": "Radau", "rtol": 1e-9},
)
"""Solvers of the second response by python-control, with steps no longer than the spacing of samples."""

MAXIMUM_STEPS = 20_000
"""Maximum number of steps of one of them."""


def differences(ours, reference):
    """Differences as (field, text, size), with the size relative to the tolerance; empty if the two agree."""
    if isinstance(reference, list) or isinstance(ours, list):
        if not isinstance(reference, list) or not isinstance(ours, list) or len(ours) != len(reference):
            return [("kind", f"{type(ours).__name__} for {type(reference).__name__}", np.inf)]
        return [entry for pair in zip(ours, reference, strict=True) for entry in differences(*pair)]
    if isinstance(ours, Exception) or isinstance(reference, Exception):
        return _of_failures(ours, reference)
    if not reference.success:
        return [("success", f"answered, where python-control failed: {reference.message}", np.inf)]
    found = [
        (name, f"{mine!r:.120} for {theirs!r:.120}", np.inf)
        for name, mine, theirs in (
            (name, getattr(ours, name), getattr(reference, name))
            for name in ("issiso", "ntraces", "output_labels", "state_labels", "input_labels", "params", "sysname")
        )
        if not _same(mine, theirs)
    ]
    if not np.array_equal(ours.time, reference.time):
        found.append(("times", f"{ours.time!r:.100} for {reference.time!r:.100}", np.inf))
    raw = [("outputs", ours.y, reference.y), ("states", ours.x, reference.x), ("inputs", ours.u, reference.u)]
    sizes = [np.abs(theirs).max(initial=0.0, where=np.isfinite(theirs)) for _, _, theirs in raw if theirs is not None]
    for name, mine, theirs in raw:
        shapes = [_shape(one, name) for one in (ours, reference)]
        if shapes[0] != shapes[1] or np.shape(mine) != np.shape(theirs):
            found.append((f"shape of {name}", f"{shapes[0]} for {shapes[1]}", np.inf))
        elif theirs is not None:
            found += _of_signals(name, mine, theirs, max(sizes))
    return found


def _of_failures(ours, reference):
    """Difference if a response is an exception."""
    if isinstance(reference, Exception):
        if not isinstance(ours, Exception):
            return [("raises", f"answered, where python-control raises {_named(reference)}", np.inf)]
        kinds = [
            next((k for k in (TypeError, ValueError, RuntimeError) if isinstance(e, k)), Exception)
            for e in (ours, reference)
        ]
        return [] if kinds[0] is kinds[1] else [("error", f"{_named(ours)} for {_named(reference)}", np.inf)]
    if not reference.success:
        return []
    return [("raises", f"{_named(ours)} where python-control answers", np.inf)]


def _shape(response, name):
    """Shape of a signal by its property; None for the states of a response without states."""
    raw = getattr(response, {"outputs": "y", "states": "x", "inputs": "u"}[name])
    return None if raw is None else np.shape(getattr(response, name))


def _named(error):
    return f"{type(error).__name__}: {error}"[:300]


def _of_signals(name, mine, theirs, largest):
    """Signals of one kind that differ."""
    found = []
    if mine.size == 0:
        return found
    if np.iscomplexobj(theirs) and not np.iscomplexobj(mine):
        mine = mine.astype(complex)
    same = (mine == theirs) | (np.isnan(mine) & np.isnan(theirs))
    with np.errstate(all="ignore"):
        gap = np.where(same, 0.0, np.abs(mine - theirs))
        finite = np.where(np.isfinite(theirs), theirs, 0.0).real
        span = finite.max(axis=-1) - finite.min(axis=-1)
        allowed = np.maximum(AGREEMENT * span, ROUNDING * largest)
        worst = gap.max(axis=-1) / np.maximum(allowed, 1e-300)
    for row, size in enumerate(worst):
        if not size <= 1.0:
            k = int(np.nan_to_num(gap[row], nan=np.inf).argmax())
            values = f"{mine[row, k]:.12g} for {theirs[row, k]:.12g}"
            text = f"row {row}, sample {k}: {values}, {size * AGREEMENT:.2g} of the range"
            found.append((name, text, float(size)))
    return found


def _same(mine, theirs):
    mine, theirs = (None if isinstance(value, dict) and not value else value for value in (mine, theirs))
    if isinstance(mine, dict) and isinstance(theirs, dict):
        return mine.keys() == theirs.keys() and all(_same(mine[key], theirs[key]) for key in mine)
    try:
        return bool(np.all(mine == theirs))
    except Exception:
        return mine is theirs


def better_answers(originals, function, system, options, first):
    """More accurate responses of python-control, one by one; none if its first has only rounding errors."""
    if not isinstance(first, ct.TimeResponseData) or first.x is None or not ct.isctime(system) or not first.success:
        return
    if function == "forced_response" and isinstance(system, (ct.StateSpace, ct.TransferFunction)):
        return
    options = {name: value for name, value in options.items() if name not in ("method", "solve_ivp_method")}
    options.pop("interpolate", None)
    given = dict(options.pop("solve_ivp_kwargs", None) or {})
    options["evaluation_times"] = first.t
    samples = np.union1d(options["timepts"], first.t)
    largest = np.abs(first.x).max(axis=1)
    atol = 1e-13 * np.maximum(largest, 1e-6 * largest.max(initial=0.0)) + 1e-300
    kept = {name: value for name, value in given.items() if name not in ("rtol", "atol", "method", "t_eval")}
    solvers = [kept | {"atol": atol, "max_step": np.diff(samples).max()} | solver for solver in TIGHT]
    attempts = [partial(_whole, originals, system, options, solver) for solver in solvers]
    if _has_kinks(first) and np.array_equal(first.t, samples):
        attempts.insert(0, partial(_from_sample_to_sample, originals, system, options, solvers[1], first))
    for attempt in attempts:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield attempt()
        except Exception:
            continue


def _whole(originals, system, options, solver):
    """Response in one run."""
    return originals["input_output_response"](system, solve_ivp_kwargs=solver | {"events": _limit()}, **options)


def _from_sample_to_sample(originals, system, options, solver, first):
    """Response restarted at each sample: a solver requires many small steps at a kink of an input."""
    states, outputs, limit = [first.x[:, 0]], [first.y[:, 0]], _limit()
    for k in range(first.t.size - 1):
        part = originals["input_output_response"](
            system,
            first.t[k : k + 2],
            first.u[:, k : k + 2],
            states[-1],
            params=options.get("params"),
            solve_ivp_kwargs=solver | {"events": limit},
        )
        states.append(part.x[:, -1])
        outputs.append(part.y[:, -1])
    better = copy.copy(first)
    better.x, better.y = np.array(states).T, np.array(outputs).T
    return better


def _has_kinks(response):
    """Whether an input, linear between samples, changes its slope."""
    if response.u is None or response.u.ndim != 2 or response.t.size < 3:
        return False
    slopes = np.diff(response.u) / np.diff(response.t)
    return bool(np.any(np.abs(np.diff(slopes)) > 1e-9 * np.abs(slopes).max(initial=0.0)))


def _limit():
    """An event that does not occur, but ends a run of too many steps."""
    steps = count()

    def limit(_time, _state):
        if next(steps) > MAXIMUM_STEPS:
            raise RuntimeError("too many steps")
        return 1.0

    return limit
