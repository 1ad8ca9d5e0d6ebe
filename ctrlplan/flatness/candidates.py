"""Sets of outputs and states of a plant that are flat outputs, and the check of maps against the dynamics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import control.flatsys as fs
import numpy as np
from scipy.linalg import matrix_balance

from ctrlplan._display import Displayed, Facts, Part
from ctrlplan._types import Array, Params, System
from ctrlplan.flatness.derived import DerivedFlatSystem
from ctrlplan.flatness.deriving import flat_system
from ctrlplan.flatness.errors import NotFlatError
from ctrlplan.flatness.system import FlatSystem
from ctrlplan.flatness.verify import FlatPlant, checked_plant, finite_rows, random_probes

if TYPE_CHECKING:
    from ctrlplan.flatness.operating_point import At

_MOST = 300
"""Maximum number of sets that are analysed."""

_STEP = 2e-4
"""Step of the differences along a jet, relative to the time constant of the plant."""


@dataclass(frozen=True, repr=False)
class FlatCandidate(Displayed):
    """Flat outputs of a plant, as found by `flat_candidates`.

    Attributes
    ----------
    outputs : tuple of str
        Names of outputs or states that are flat outputs.
    orders : tuple of int
        Highest derivative of each.
    extension : int
        Number of states of the dynamic extension.
    """

    outputs: tuple[str, ...]
    orders: tuple[int, ...]
    extension: int

    def _describe(self) -> Iterator[Part]:
        yield f"FlatCandidate: {', '.join(self.outputs)}"
        yield Facts([("orders", ", ".join(map(str, self.orders))), ("dynamic extension", f"{self.extension} states")])


@dataclass(frozen=True, repr=False)
class FlatCheck(Displayed):
    """Maps of a flat system compared with its dynamics.

    Attributes
    ----------
    residual : float
        Largest difference between the derivative of a state along a jet and its
        rate from the equations, relative to the size of the two.
    signal : str
        The state with this difference, or the flat output whose flag differs.
    where : dict of str to float
        States and inputs there.
    """

    residual: float
    signal: str
    where: Mapping[str, float]

    @property
    def passed(self) -> bool:
        """Whether the maps agree with the dynamics to 1e-6."""
        return self.residual < 1e-6

    def _describe(self) -> Iterator[Part]:
        verdict = "agree with" if self.passed else "contradict"
        yield f"FlatCheck: the maps {verdict} the dynamics, largest difference {self.residual:.3g}"
        where = ", ".join(f"{name} = {value:.4g}" for name, value in self.where.items())
        yield Facts([("signal", self.signal), ("at", where)])


def flat_candidates(
    system: System,
    *,
    inputs: Sequence[str] | str | None = None,
    at: At = None,
    params: Params | None = None,
) -> tuple[FlatCandidate, ...]:
    """Sets of outputs and states that are flat, simplest first.

    Parameters
    ----------
    system : control.NonlinearIOSystem or control.StateSpace
        The plant, as for `flat_system`.
    inputs, at, params : optional
        As for `flat_system`.

    Returns
    -------
    tuple of FlatCandidate
        Sorted by the states of the extension, then by the highest order; empty if
        there is none. Flat outputs can be other functions of the states as well.

    Raises
    ------
    ImportError, TypeError, ValueError
        As `flat_system`; also for more than 300 sets.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> import numpy as np
    >>> def rates(t, x, u, params):
    ...     return [u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[1]]
    >>> names = ["x", "y", "heading"]
    >>> unicycle = ct.nlsys(rates, inputs=["speed", "turn"], states=names, outputs=names)
    >>> [(flat.outputs, flat.orders) for flat in cp.flat_candidates(unicycle)]
    [(('x', 'y'), (2, 2))]
    """
    states, outputs = list(system.state_labels or ()), list(system.output_labels or ())
    names = list(dict.fromkeys([*outputs, *states]))
    count = len(inputs) if inputs is not None and not isinstance(inputs, str) else 1 if inputs else system.ninputs
    sets = list(combinations(names, count))
    if len(sets) > _MOST:
        raise ValueError(
            f"system must have at most {_MOST} sets of {count} outputs and states, got {len(sets)}; try sets of your "
            "own with flat_system"
        )
    found = []
    for chosen in sets:
        try:
            flat = flat_system(system, chosen, inputs=inputs, at=at, params=params)
        except NotFlatError:
            continue
        found.append(FlatCandidate(chosen, flat.orders, flat.extension))
    return tuple(sorted(found, key=lambda one: (one.extension, max(one.orders), [names.index(n) for n in one.outputs])))


def check_flat(system: fs.FlatSystem) -> FlatCheck:
    """Compare the maps of a flat system with its dynamics.

    Along random jets the states from `reverse` must satisfy x' = f(x, u), with
    the derivative by differences of high order; the flag from `forward` must be
    that of the jet in the entries that depend on states only.

    Parameters
    ----------
    system : control.flatsys.FlatSystem
        In continuous time, with equations of motion.

    Returns
    -------
    FlatCheck
        The worst difference and where it is.

    Raises
    ------
    TypeError
        If `system` is not a `control.flatsys.FlatSystem`.
    ValueError
        If it is in discrete time, or the maps are finite nowhere.

    Examples
    --------
    >>> import ctrlplan as cp
    >>> cp.check_flat(cp.plants.Crane().flat_system()).passed
    True
    """
    plant = checked_plant(system, "system")
    worst = FlatCheck(0.0, str(system.state_labels[0]), {})
    orders, centre = _middle(system, plant)
    for residual, signal, where in _differences(plant, orders, centre):
        if residual > worst.residual:
            worst = FlatCheck(residual, signal, where)
    return worst


def _middle(system: fs.FlatSystem, plant: FlatPlant) -> tuple[list[int], list[Array]]:
    """Orders of the flat outputs, and a flag around which jets are drawn."""
    if not isinstance(system, FlatSystem):
        probes = random_probes(plant)
        return probes[0].orders, probes[0].flag
    point = system.operating_point if isinstance(system, DerivedFlatSystem) else {}
    x, u = (
        np.array([point.get(name, 0.0) for name in labels]) for labels in (system.state_labels, system.input_labels)
    )
    rows = finite_rows(plant.forward, x, u) or [np.zeros(r + 1) for r in system.orders]
    return list(system.orders), [row[: r + 1] for row, r in zip(rows, system.orders, strict=True)]


def _differences(
    plant: FlatPlant, orders: Sequence[int], centre: Sequence[Array]
) -> Iterator[tuple[float, str, dict[str, float]]]:
    """Relative differences along random jets, with the state and the point."""
    rng = np.random.default_rng(3)
    found = 0
    rates = (1.0, _rate(plant, centre))
    for trial in range(60):
        size, rate = 1.0 if trial % 2 else 0.1, rates[trial // 2 % 2]
        powers = [rate ** np.arange(row.size + 4) for row in centre]
        jets = [
            np.pad(row, (0, 4)) + size * power * rng.normal(size=power.size)
            for row, power in zip(centre, powers, strict=True)
        ]
        rows = _along(plant, jets, orders, rate)
        if rows is None:
            continue
        found += 1
        yield from rows
        if found == 16:
            return
    if not found:
        raise ValueError(f"reverse of {plant.system.name} must be finite along some of the random jets, got none")


def _rate(plant: FlatPlant, centre: Sequence[Array]) -> float:
    """Largest magnitude of an eigenvalue [1/s] of the plant near a flag, by differences; 1 where it is 0."""
    known = finite_rows(plant.reverse, list(centre)) or finite_rows(plant.reverse, [row + 0.1 for row in centre])
    if known is None:
        return 1.0
    x, u = known
    steps = 1e-6 * np.maximum(np.abs(x), 1e-3) * np.eye(x.size)
    around = [finite_rows(plant.rates, x + sign * step, u) for step in steps for sign in (1.0, -1.0)]
    values = np.array([np.full(x.size, np.nan) if row is None else row[0] for row in around])
    slopes = ((values[::2] - values[1::2]) / (2.0 * steps.diagonal()[:, None])).T
    if not np.isfinite(slopes).all():
        return 1.0
    balanced = matrix_balance(slopes)[0]  # entries in comparable units
    largest = float(np.abs(np.linalg.eigvals(balanced)).max())
    return largest if 1e-6 * float(np.abs(balanced).max()) < largest else 1.0


def _along(
    plant: FlatPlant, jets: list[Array], orders: Sequence[int], rate: float
) -> list[tuple[float, str, dict[str, float]]] | None:
    """Differences at the middle of a jet; None outside of the domain."""

    def at(t: float) -> list[Array] | None:
        flags = []
        for jet, r in zip(jets, orders, strict=True):
            series = jet / np.cumprod([1.0, *range(1, jet.size)])
            polynomial = np.polynomial.Polynomial(series)
            flags.append(np.array([polynomial.deriv(k)(t) if k else polynomial(t) for k in range(r + 1)]))
        return finite_rows(plant.reverse, flags)

    weights = {-3: -1 / 60, -2: 3 / 20, -1: -3 / 4, 1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    step = _STEP / rate
    known: dict[int, list[Array]] = {}
    for k in (0, *weights):
        point = at(k * step)
        if point is None:  # the search for a state that does not exist takes long
            return None
        known[k] = point
    x, u = known[0]
    rates = finite_rows(plant.rates, x, u)
    if rates is None:
        return None
    derivative = np.sum([weight * known[k][0] for k, weight in weights.items()], axis=0) / step
    spread = max(float(np.abs(known[k][0] - x).max() / (1.0 + np.abs(x).max())) for k in weights)
    if spread > 0.05:  # another branch between the points, or too fast for differences
        return None
    names = [*plant.system.state_labels, *plant.system.input_labels]
    where = dict(zip(names, [*x.tolist(), *u.tolist()], strict=True))
    floor = 1e-3 * max(min(1.0, rate), float(np.abs(rates[0]).max()))
    # Rates are differences of terms that can be larger: their change for states that are changed by 1e-8.
    changed = finite_rows(plant.rates, x * (1.0 + 1e-8 * np.cos(np.arange(x.size))), u)
    rounding = 0.0 if changed is None else np.abs(changed[0] - rates[0])
    size = np.abs(derivative) + np.abs(rates[0]) + floor + rounding
    return [
        (float(abs(a - b) / s), str(name), where)
        for a, b, s, name in zip(derivative, rates[0], size, plant.system.state_labels, strict=True)
    ]
