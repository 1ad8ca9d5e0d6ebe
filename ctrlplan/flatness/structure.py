"""Structure of a flat plant: orders of the flat outputs and dynamic extension, by the dynamic extension algorithm.

The flat outputs are differentiated along the motion until a control appears. If
controls appear in too few independent combinations, one combination becomes a
state and its derivative a control, and differentiation goes on. The plant is flat
for these outputs if and only if the outputs and their derivatives determine all
states, those of the extension included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvals

from ctrlplan._types import Array
from ctrlplan.flatness.errors import NotFlatError
from ctrlplan.flatness.generic import Copies, Point
from ctrlplan.symbolic.taping import tape_of

_LEAST_VARIATION = 0.02
"""Variation of a pivot's determinant above which no smaller region is tried."""


@dataclass(frozen=True, eq=False)
class Round:
    """One extension: the combination w = mu_p + N mu_o of controls becomes a state.

    Attributes
    ----------
    rows : tuple of int
        Flat outputs whose highest derivatives depend on each other.
    orders : tuple of int
        Order of each flat output in this round.
    combination : casadi.SX
        w as a function of states and controls before the extension.
    matrix : casadi.SX
        Influence of mu_p on the rows.
    drift : casadi.SX
        The rows where mu_p and mu_o are 0.
    states : casadi.SX
        The new states w.
    """

    rows: tuple[int, ...]
    orders: tuple[int, ...]
    combination: ca.SX
    matrix: ca.SX
    drift: ca.SX
    states: ca.SX


@dataclass(frozen=True, eq=False)
class Extension:
    """Controls that became states of the extension: mu_p = w - N mu_o.

    Attributes
    ----------
    controls : casadi.SX
        mu before the extension.
    pivots : tuple of int
        Places of mu_p in mu, which afterwards are those of w'.
    mixed : casadi.SX
        N mu_o as a function of states and the other controls.
    states : casadi.SX
        w.
    """

    controls: ca.SX
    pivots: tuple[int, ...]
    mixed: ca.SX
    states: ca.SX


@dataclass(frozen=True, eq=False)
class Structure:
    """Extended plant z' = F(z, mu) and the derivatives of its flat outputs.

    Attributes
    ----------
    z, mu, p : casadi.SX
        States (those of the plant, then those of the extension), controls of the
        extended plant, parameters.
    rates : casadi.SX
        F.
    flags : tuple of casadi.SX
        Of each flat output y_j, ..., y_j^(r_j - 1), as functions of z.
    last : casadi.SX
        y_j^(r_j), as functions of z and mu.
    controls : casadi.SX
        Controls of the plant as functions of z and mu.
    rounds : tuple of Round
        The extensions by combinations of controls.
    extensions : tuple of Extension
        All extensions, in their order.
    prolonged : bool
        Whether a control became a state by itself.
    nstates : int
        Number of states of the plant, the first of z.
    point, scales : ndarray, shape (nz + m,)
        Operating point and scales of (z, mu).
    """

    z: ca.SX
    mu: ca.SX
    p: ca.SX
    rates: ca.SX
    flags: tuple[ca.SX, ...]
    last: ca.SX
    controls: ca.SX
    rounds: tuple[Round, ...]
    extensions: tuple[Extension, ...]
    prolonged: bool
    nstates: int
    point: Array
    scales: Array

    @property
    def orders(self) -> tuple[int, ...]:
        """Highest derivative of each flat output."""
        return tuple(flag.numel() for flag in self.flags)

    @property
    def extension(self) -> int:
        """Number of states of the extension."""
        return int(self.z.numel()) - self.nstates


@dataclass(frozen=True, eq=False)
class Plant:
    """What the algorithm starts from.

    Attributes
    ----------
    name : str
        Name of the plant.
    z, mu, p : casadi.SX
        Columns of symbols of states, controls, parameters.
    rates, flat : casadi.SX
        Rates and flat outputs.
    controls : casadi.SX
        Controls as functions of mu.
    labels : tuple of str
        Names of the flat outputs.
    point, scales : ndarray
        Operating point and scales of (z, mu).
    rate : float
        Rate of the dynamics [1/s].
    values : ndarray
        Parameters.
    equilibrium : bool
        Whether the operating point is one.
    """

    name: str
    z: ca.SX
    mu: ca.SX
    p: ca.SX
    rates: ca.SX
    flat: ca.SX
    controls: ca.SX
    labels: tuple[str, ...]
    point: Array
    scales: Array
    rate: float
    values: Array
    equilibrium: bool


def structure_of(plant: Plant) -> Structure:
    """Orders and extension of a plant.

    Raises
    ------
    NotFlatError
        If the plant is not flat for its flat outputs.
    """
    return _Algorithm(plant).run()


@dataclass(eq=False)
class _Algorithm:
    """State of the algorithm: the extended plant so far."""

    plant: Plant
    z: list[ca.SX] = field(init=False)
    mu: list[ca.SX] = field(init=False)
    rates: ca.SX = field(init=False)
    controls: ca.SX = field(init=False)
    rounds: list[Round] = field(default_factory=list)
    extensions: list[Extension] = field(default_factory=list)
    prolonged: bool = False

    def __post_init__(self) -> None:
        plant = self.plant
        self.z, self.mu = ca.vertsplit(plant.z), ca.vertsplit(plant.mu)
        self.rates, self.controls = plant.rates, plant.controls
        self.highest = list(ca.vertsplit(plant.flat))
        self.flags: list[list[ca.SX]] = [[] for _ in self.highest]
        n = len(self.z)
        self.centre = plant.point.copy()
        self.scale = plant.scales.copy()
        self.n = n
        self.at = self._random_point()

    @property
    def column(self) -> ca.SX:
        return ca.vertcat(*self.z)

    @property
    def inputs(self) -> ca.SX:
        return ca.vertcat(*self.mu)

    def run(self) -> Structure:
        m = len(self.mu)
        for count in range(2 * m + self.n + 1):
            self._differentiate()
            last = ca.vertcat(*self.highest)
            influence = self._generic(ca.jacobian(last, self.inputs), self.scale[len(self.z) :])
            self._check_independent()
            if influence.rank() == m:
                return self._result(last)
            dependent = influence.dependent_rows()
            curved = self._curved(dependent)
            if curved:
                self._prolong(curved)
            else:
                self._extend(dependent, influence, count)
        raise NotFlatError(f"{self.plant.name} is not flat for the outputs {', '.join(self.plant.labels)}")

    def _generic(self, matrix: ca.SX, weights: Array | None = None) -> Copies:
        return self.at(matrix, weights)

    def _differentiate(self) -> None:
        """Differentiate each flat output until a control appears."""
        for j, flag in enumerate(self.flags):
            while not self._depends(self.highest[j]):
                # A dependence that is generically 0 is removed from the expression.
                flag.append(ca.substitute(self.highest[j], self.inputs, ca.DM(self.centre[len(self.z) :])))
                if len(flag) > len(self.z):
                    self._raise_dependent()
                self.highest[j] = ca.cse(ca.jtimes(flag[-1], self.column, self.rates))

    def _depends(self, expression: ca.SX) -> bool:
        """Whether an expression depends on a control."""
        if not ca.depends_on(expression, self.inputs):
            return False
        slopes = ca.jacobian(expression, ca.vertcat(self.column, self.inputs))
        return bool(self._generic(slopes, self.scale).nonzero[0, len(self.z) :].any())

    def _check_independent(self) -> None:
        """Raise if the derivatives of the flat outputs satisfy a relation."""
        entries = ca.vertcat(ca.SX(0, 1), *(entry for flag in self.flags for entry in flag))
        if entries.numel() and self._generic(ca.jacobian(entries, self.column), self.scale[: len(self.z)]).rank() < (
            entries.numel()
        ):
            self._raise_dependent()

    def _raise_dependent(self) -> None:
        """Raise with the outputs that depend on each other."""
        plant = self.plant
        entries = [(j, entry) for j, flag in enumerate(self.flags) for entry in flag]
        found = self._generic(
            ca.jacobian(ca.vertcat(*(entry for _, entry in entries)), self.column), self.scale[: len(self.z)]
        )
        involved = sorted({entries[k][0] for k in found.dependent_rows()})
        names = [plant.labels[j] for j in involved]
        if len(names) == 1:
            raise NotFlatError(
                f"{plant.name} is not flat for the outputs {', '.join(plant.labels)}: no control has an effect on "
                f"{names[0]}"
            )
        raise NotFlatError(
            f"{plant.name} is not flat for the outputs {', '.join(plant.labels)}: {', '.join(names)} and their "
            "derivatives depend on each other"
        )

    def _curved(self, rows: Sequence[int]) -> list[int]:
        """Controls in which the highest derivatives of rows are not affine."""
        slopes = ca.jacobian(ca.vertcat(*(self.highest[j] for j in rows)), self.inputs)
        curvature = ca.jacobian(ca.vec(slopes), self.inputs)
        if curvature.nnz() == 0:
            return []
        weights = self.scale[len(self.z) :]
        found = self._generic(curvature, weights).nonzero.reshape(len(self.mu), len(rows), len(self.mu))
        return np.flatnonzero(found.any(axis=(1, 2))).tolist()

    def _prolong(self, chosen: Sequence[int]) -> None:
        """Make controls states, and their derivatives controls."""
        self.prolonged = True
        for k in chosen:
            count = len(self.z) - self.n
            old, new = self.mu[k], ca.SX.sym(f"w{count + 1}_d1")
            self.extensions.append(Extension(self.inputs, (k,), ca.SX.zeros(1), old))
            at = len(self.z) + k
            self.z.append(old)
            self.rates = ca.vertcat(self.rates, new)
            self.mu[k] = new
            self._move_scale(at, self.centre[at], self.scale[at])
        self.at = self._random_point()

    def _move_scale(self, control: int, centre: float, size: float) -> None:
        """Insert a new state's centre and scale; the control at its place becomes its derivative."""
        place = len(self.z) - 1
        self.centre[control] = 0.0
        self.scale[control] = size * self.plant.rate
        self.centre = np.insert(self.centre, place, centre)
        self.scale = np.insert(self.scale, place, size)

    def _extend(self, rows: list[int], influence: Copies, count: int) -> None:
        """Make combinations of controls states."""
        nz = len(self.z)
        chosen = influence.rows(rows)
        rank = chosen.rank()
        pivots = self._pivots(rows, rank, chosen)
        others = [k for k in range(len(self.mu)) if k not in pivots]
        last = ca.vertcat(*(self.highest[j] for j in rows))
        slopes = ca.jacobian(last, self.inputs)
        sizes = np.abs(chosen.numbers() * self.scale[nz:]).max(axis=1)
        weight = ca.diag(ca.DM((1.0 / sizes) ** 2))
        first, rest = slopes[:, pivots], slopes[:, others]
        combined = _without_zeros(ca.inv_minor(first.T @ weight @ first) @ (first.T @ weight @ rest), self._generic)
        idle = ca.substitute(last, self.inputs, ca.SX.zeros(len(self.mu)))
        states = [ca.SX.sym(f"w{nz - self.n + k + 1}") for k in range(rank)]
        derivatives = [ca.SX.sym(f"w{nz - self.n + k + 1}_d1") for k in range(rank)]
        w = ca.vertcat(*states)
        old, kept = ca.vertcat(*(self.mu[k] for k in pivots)), ca.vertcat(ca.SX(0, 1), *(self.mu[k] for k in others))
        mixed = combined @ kept if others else ca.SX.zeros(rank)
        combination, inverse = old + mixed, w - mixed
        self.extensions.append(Extension(self.inputs, tuple(pivots), mixed, w))
        self.rounds.append(Round(tuple(rows), tuple(len(flag) for flag in self.flags), combination, first, idle, w))
        exact = tape_of((self.column, self.inputs, self.plant.p), combination)(
            self.centre[:nz], self.centre[nz:], self.plant.values
        )
        self.rates = ca.vertcat(ca.substitute(self.rates, old, inverse), *derivatives)
        self.controls = ca.substitute(self.controls, old, inverse)
        replaced = idle + first @ w
        for j in range(len(self.highest)):
            if j in rows:
                self.highest[j] = replaced[rows.index(j)]
            else:
                self.highest[j] = ca.substitute(self.highest[j], old, inverse)
        control_centre, control_scale = self.centre[nz:].copy(), self.scale[nz:].copy()
        new_centre = np.where(np.isfinite(exact), exact, control_centre[pivots])
        new_scale = np.where(
            np.isfinite(exact), np.maximum(np.abs(exact), control_scale[pivots]), control_scale[pivots]
        )
        self.z += states
        for k, i in enumerate(pivots):
            self.mu[i] = derivatives[k]
            control_centre[i], control_scale[i] = 0.0, new_scale[k] * self.plant.rate
        self.centre = np.concatenate([self.centre[:nz], new_centre, control_centre])
        self.scale = np.concatenate([self.scale[:nz], new_scale, control_scale])
        self.at = self._random_point()

    def _pivots(self, rows: Sequence[int], rank: int, influence: Copies) -> list[int]:
        """Controls to replace: their influence keeps its size best near the operating point."""
        nz = len(self.z)
        candidates = [
            list(chosen)
            for chosen in combinations(range(len(self.mu)), rank)
            if influence.columns(chosen).rank() == rank
        ]
        if len(candidates) == 1:
            return candidates[0]
        slopes = ca.jacobian(ca.vertcat(*(self.highest[j] for j in rows)), self.inputs)
        tape = tape_of((self.column, self.inputs, self.plant.p), slopes)
        sizes = np.abs(influence.numbers() * self.scale[nz:]).max(axis=1)
        best: list[float] = []
        for region in (0.5, 0.15, 0.05, 0.005):
            points = np.column_stack(list(nearby(self.centre, self.scale, region)))
            values = tape(points[:nz], points[nz:], self.plant.values[:, None]) / sizes[:, None, None]
            values = values.reshape(len(rows), len(self.mu), -1)
            best = [_variation(values[:, chosen]) for chosen in candidates]
            if max(best) > _LEAST_VARIATION:
                break
        return candidates[int(np.argmax(best))]

    def _random_point(self) -> Point:
        """Point near the operating point where the equations are finite."""
        rng = np.random.default_rng(0)
        direction = rng.uniform(0.1, 0.2, self.centre.size) * rng.choice([-1.0, 1.0], self.centre.size)
        nz = len(self.z)
        tape = tape_of(
            (self.column, self.inputs, self.plant.p),
            ca.vertcat(self.rates, *self.highest, *(entry for flag in self.flags for entry in flag)),
        )
        for _ in range(12):
            values = self.centre + direction * self.scale
            if np.isfinite(tape(values[:nz], values[nz:], self.plant.values)).all():
                return Point((self.column, self.inputs, self.plant.p), (values[:nz], values[nz:]), (self.plant.values,))
            direction = direction / 4.0
        raise ValueError(f"equations of {self.plant.name} must be finite near the operating point; choose another at=")

    def _result(self, last: ca.SX) -> Structure:
        """The structure, or the error that the outputs do not determine all states."""
        plant = self.plant
        orders = [len(flag) for flag in self.flags]
        missing = len(self.z) - sum(orders)
        if missing:
            raise NotFlatError(
                f"{plant.name} is not flat for the outputs {', '.join(plant.labels)}: they do not determine "
                f"{missing} of its states (internal dynamics of dimension {missing}{self._stability(missing)})"
                f"{self._none_at_all()}",
                missing,
            )
        return Structure(
            z=self.column,
            mu=self.inputs,
            p=plant.p,
            rates=self.rates,
            flags=tuple(ca.vertcat(ca.SX(0, 1), *flag) for flag in self.flags),
            last=last,
            controls=self.controls,
            rounds=tuple(self.rounds),
            extensions=tuple(self.extensions),
            prolonged=self.prolonged,
            nstates=self.n,
            point=self.centre,
            scales=self.scale,
        )

    def _stability(self, missing: int) -> str:
        """Stability of the internal dynamics, linearised at the operating point: the zeros there."""
        plant = self.plant
        if self.n != len(self.z) or not plant.equilibrium:
            return ""
        zeros = zeros_at(plant)
        if zeros is None or zeros.size != missing:
            return ""
        shown = ", ".join(f"{zero.real:.4g}{f'{zero.imag:+.4g}j' if zero.imag else ''}" for zero in zeros)
        largest = max(1.0, float(np.abs(zeros).max()))
        if (zeros.real < -1e-9 * largest).all():
            return (
                f", stable at the operating point: poles {shown}; control by linearisation of these outputs is possible"
            )
        if (zeros.real > 1e-9 * largest).any():
            return f", unstable at the operating point with the poles {shown}"
        return f", poles {shown} at the operating point"

    def _none_at_all(self) -> str:
        """Whether no other output is flat either, which is known for one control."""
        if self.plant.mu.numel() == 1 and not _has_flat_output(self.plant):
            return "; no output of this plant is flat"
        return ""


def nearby(centre: Array, scales: Array, region: float) -> Iterator[Array]:
    """A point, and eight points at random within a number of scales of it."""
    rng = np.random.default_rng(1)
    yield centre
    for _ in range(8):
        yield centre + region * scales * rng.uniform(-1.0, 1.0, centre.size)


def steadiness(values: Array) -> float:
    """Smallest over largest determinant of matrices (rank, rank, n); 0 where it changes sign."""
    found = np.linalg.det(np.moveaxis(values, -1, 0))
    if not np.isfinite(found).all() or (np.sign(found) != np.sign(found[0])).any() or not found.all():
        return 0.0
    return float(np.abs(found).min() / np.abs(found).max())


def zeros_at(plant: Plant) -> NDArray[np.complex128] | None:
    """Invariant zeros of the linearisation at the operating point; None if it is singular."""
    n, m = plant.z.numel(), plant.mu.numel()
    both = ca.vertcat(plant.z, plant.mu)
    tape = tape_of((plant.z, plant.mu, plant.p), ca.jacobian(ca.vertcat(plant.rates, plant.flat), both))
    matrix = tape(plant.point[:n], plant.point[n:], plant.values)
    if not np.isfinite(matrix).all():
        return None
    size = np.concatenate([plant.scales[:n], plant.scales[n:]])
    rows = np.concatenate([plant.scales[:n] * plant.rate, np.ones(m)])
    pencil = matrix * size / rows[:, None]
    peaks = np.abs(pencil[n:]).max(axis=1, keepdims=True)
    if not peaks.all():
        return None
    pencil[n:] /= peaks
    found = eigvals(pencil, np.diag([1.0] * n + [0.0] * m), homogeneous_eigvals=True)
    top, bottom = found
    finite = np.abs(bottom) > 1e-8 * np.abs(top)
    return np.sort_complex(top[finite] / bottom[finite] * plant.rate)


def _has_flat_output(plant: Plant) -> bool:
    """Whether a plant with one control, affine in it, has a flat output: by Lie brackets (Jakubczyk, Respondek)."""
    slope = ca.jacobian(plant.rates, plant.mu)
    if ca.depends_on(slope, plant.mu):
        return True  # not decided
    drift = ca.substitute(plant.rates, plant.mu, 0.0)
    n = plant.z.numel()
    algorithm = _Algorithm(plant)
    fields = [slope]
    for _ in range(n - 1):
        fields.append(_bracket(drift, fields[-1], plant.z))
    weights = 1.0 / plant.scales[:n]

    def rank(columns: Sequence[ca.SX]) -> int:
        return algorithm.at(ca.horzcat(*columns).T, weights).rank()

    if rank(fields) < n:
        return False
    brackets = [_bracket(first, second, plant.z) for first, second in combinations(fields[: n - 1], 2)]
    return n < 3 or all(rank([*fields[: n - 1], bracket]) == n - 1 for bracket in brackets)


def _bracket(first: ca.SX, second: ca.SX, z: ca.SX) -> ca.SX:
    """Lie bracket of two vector fields."""
    return ca.cse(ca.jtimes(second, z, first) - ca.jtimes(first, z, second))


def _without_zeros(matrix: ca.SX, generic: Callable[[ca.SX], Copies]) -> ca.SX:
    """Matrix with entries that are generically 0 set to 0."""
    out = ca.SX(*matrix.shape)
    if matrix.nnz() == 0:
        return out
    for i, j in zip(*np.nonzero(generic(matrix).nonzero), strict=True):
        out[int(i), int(j)] = matrix[int(i), int(j)]
    return out


def _variation(values: Array) -> float:
    """Smallest over largest size of a pivot matrix over points, 0 where its determinant changes sign."""
    matrices = np.moveaxis(values, -1, 0)
    if not np.isfinite(matrices).all():
        return 0.0
    if matrices.shape[1] == matrices.shape[2]:
        found = np.linalg.det(matrices)
        if (np.sign(found) != np.sign(found[0])).any():
            return 0.0
        sizes = np.abs(found)
    else:
        sizes = np.sqrt(np.maximum(np.linalg.det(np.swapaxes(matrices, 1, 2) @ matrices), 0.0))
        if matrices.shape[2] == 1:
            first = matrices[:, :, 0]
            changes = (np.sign(first) != np.sign(first[0])).any(axis=0)
            if changes.all():
                return 0.0
    return float(sizes.min() / sizes.max()) if sizes.max() > 0.0 else 0.0
