"""Equations of a plant as CasADi expressions of its states, controls and parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real

import casadi as ca
import control as ct
import numpy as np

from ctrlplan._checks import check_signals, checked_names, default_labels
from ctrlplan._types import Array, BlockMap, Params, System, Value
from ctrlplan.symbolic.symbols import Symbol, column_of, symbol_array
from ctrlplan.symbolic.tracing import Trace, described, traced
from ctrlplan.traits import traits_of

FlatOutputs = Sequence[str] | str | Callable[..., Value]
"""Names of outputs or states, or a function h(x, u, params)."""


@dataclass(frozen=True, eq=False)
class Equations:
    """x' = f(x, u, p) and y = h(x, u, p) of a plant.

    Attributes
    ----------
    name : str
        Name of the plant.
    x, u, p : casadi.SX
        Columns of states, controls and parameters.
    rates, outputs, flat : casadi.SX
        Columns of f, of the plant's outputs, and of h, the flat outputs.
    states, inputs, parameters, output_labels, flat_labels : tuple of str
        Names of the entries. Parameters are the scalar parameters of the plant,
        and its inputs that are not controls.
    values : ndarray, shape (nparameters,)
        Values of the parameters.
    held : tuple of str
        Inputs that are not controls.
    """

    name: str
    x: ca.SX
    u: ca.SX
    p: ca.SX
    rates: ca.SX
    outputs: ca.SX
    flat: ca.SX
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: tuple[str, ...]
    output_labels: tuple[str, ...]
    flat_labels: tuple[str, ...]
    values: Array
    held: tuple[str, ...]

    @property
    def variables(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Columns x, u and p."""
        return self.x, self.u, self.p

    @property
    def names(self) -> tuple[str, ...]:
        """Names of states and controls."""
        return self.states + self.inputs


def equations_of(
    system: System,
    flat_outputs: FlatOutputs,
    inputs: Sequence[str] | str | None,
    params: Params,
    guess: Mapping[str, float],
) -> Equations:
    """Equations of a system in continuous time, verified against Python.

    Parameters
    ----------
    system : control.NonlinearIOSystem or control.StateSpace
        The plant, also an interconnection.
    flat_outputs : sequence of str, str or callable
        Names of outputs or states, or ``h(x, u, params)``.
    inputs : sequence of str or str, optional
        Controls. Default: all inputs.
    params : mapping
        Parameters that replace those of the system.
    guess : mapping of str to float
        Known values of states and inputs at the operating point, near which the
        traces are compared with Python.

    Raises
    ------
    TypeError, ValueError
        If the system is not a continuous-time state-space system, its equations
        cannot be traced, depend on time or have an algebraic loop, or a name is
        unknown.
    """
    if not isinstance(system, ct.StateSpace | ct.NonlinearIOSystem):
        raise TypeError(
            f"system must be a control.StateSpace or control.NonlinearIOSystem, got {type(system).__name__}; convert a "
            "transfer function with control.ss"
        )
    if system.dt not in (None, 0):
        raise ValueError(f"system must be in continuous time, got dt = {system.dt} of {system.name}")
    n, count = system.nstates or 0, system.ninputs or 0
    if not (n and count):
        raise ValueError(f"system must have states and inputs, got {n} and {count} of {system.name}")
    states, all_inputs = tuple(system.state_labels), tuple(system.input_labels)
    chosen = all_inputs if inputs is None else tuple(checked_names(inputs, "inputs"))
    check_signals(chosen, "inputs", all_inputs, "input")
    expressions = _Expressions(params, guess)
    x, every = ca.vertcat(*map(ca.SX.sym, states)), ca.vertcat(*map(ca.SX.sym, all_inputs))
    outputs, rates = expressions.of(system, x, every, {})
    constants = {**(system.params or {}), **params, **expressions.symbols}
    labels, flat = _flat(system, flat_outputs, x, every, outputs, constants)
    expressions.check_used(ca.vertcat(rates, outputs, flat), str(system.name))
    controls = [all_inputs.index(name) for name in chosen]
    held = [k for k in range(count) if k not in controls]
    if flat.numel() != len(controls):
        raise ValueError(
            f"flat_outputs must be as many as the controls of {system.name}, {', '.join(chosen)}, got "
            f"{', '.join(labels)}; name the controls with inputs= if others are disturbances"
        )
    if shared := [all_inputs[k] for k in held if all_inputs[k] in expressions.symbols]:
        raise ValueError(
            f"inputs that are no controls must not have names of parameters, got {', '.join(shared)} of {system.name}; "
            "rename them, or add them to inputs="
        )
    parameters = tuple(expressions.symbols) + tuple(all_inputs[k] for k in held)
    values = [expressions.values[name] for name in expressions.symbols]
    return Equations(
        name=str(system.name),
        x=x,
        u=every[controls],
        p=ca.vertcat(ca.SX(0, 1), *(symbol.sx for symbol in expressions.symbols.values()), every[held]),
        rates=rates,
        outputs=outputs,
        flat=flat,
        states=states,
        inputs=chosen,
        parameters=parameters,
        output_labels=tuple(system.output_labels),
        flat_labels=labels,
        values=np.array([*values, *(guess.get(all_inputs[k], 0.0) for k in held)], dtype=float),
        held=tuple(all_inputs[k] for k in held),
    )


def _flat(
    system: System, flat_outputs: FlatOutputs, x: ca.SX, u: ca.SX, outputs: ca.SX, params: Params
) -> tuple[tuple[str, ...], ca.SX]:
    """Names and expressions of the flat outputs."""
    if callable(flat_outputs):
        try:
            column = column_of(flat_outputs(symbol_array(x), symbol_array(u), params))
        except Exception as error:  # any exception of the user's function
            raise TypeError(
                f"flat_outputs must be a function h(x, u, params) of functions of numpy that returns the flat outputs, "
                f"got {described(error)}"
            ) from error
        return _labels(system, column, x, u, outputs), column
    names = tuple(checked_names(flat_outputs, "flat_outputs"))
    known = dict(zip(system.state_labels, ca.vertsplit(x), strict=True))
    if system.noutputs:
        known |= dict(zip(system.output_labels, ca.vertsplit(outputs), strict=True))
    check_signals(names, "flat_outputs", tuple(known), "outputs and state")
    return names, ca.vertcat(*(known[name] for name in names))


def _labels(system: System, column: ca.SX, x: ca.SX, u: ca.SX, outputs: ca.SX) -> tuple[str, ...]:
    """Names of flat outputs given by a function, which no other signal of the plant has."""
    count = column.numel()
    labels = default_labels(count)
    names = (*system.state_labels, *system.input_labels, *(system.output_labels if system.noutputs else ()))
    signals = dict(zip(names, ca.vertsplit(ca.vertcat(x, u, outputs)), strict=True))
    entries = zip(labels, ca.vertsplit(column), strict=True)
    if all(ca.is_equal(signals.get(label, entry), entry, 100) for label, entry in entries):
        return labels
    return tuple(f"flat_{label}" for label in labels)


@dataclass(frozen=True, eq=False)
class _Block:
    """Block for `traced`."""

    system: System
    params: Params

    @property
    def name(self) -> str:
        return str(self.system.name)

    def output(self, params: Params) -> BlockMap:
        function = self.system.outfcn
        if isinstance(self.system, ct.StateSpace):
            return _linear(self.system.C, self.system.D)
        return (lambda t, x, u: x) if function is None else (lambda t, x, u: function(t, x, u, params))

    def update(self, params: Params) -> BlockMap:
        function = self.system.updfcn
        if isinstance(self.system, ct.StateSpace):
            return _linear(self.system.A, self.system.B)
        return lambda t, x, u: function(t, x, u, params)


def _linear(on_state: Value, on_input: Value) -> BlockMap:
    first, second = np.asarray(on_state, dtype=float), np.asarray(on_input, dtype=float)
    return lambda t, x, u: first @ x + second @ u


class _Expressions:
    """Expressions of nested systems, with one symbol for each scalar parameter.

    Attributes
    ----------
    symbols : dict of str to Symbol
        Parameters by name.
    values : dict of str to float
        Their values.
    """

    def __init__(self, params: Params, guess: Mapping[str, float]) -> None:
        self._params, self._guess = params, guess
        self.symbols: dict[str, Symbol] = {}
        self.values: dict[str, float] = {}
        self._declared: set[str] = set()

    def check_used(self, expressions: ca.SX, name: str) -> None:
        """Raise for a parameter that no block declares and on which no expression depends."""
        for given, value in self._params.items():
            used = given in self.symbols and ca.depends_on(expressions, self.symbols[given].sx)
            if not (used or given in self._declared) and isinstance(value, Real):
                known = ", ".join(sorted(self._declared)) or "none"
                raise ValueError(f"params must be among the parameters of {name} ({known}), got {given!r}")

    def of(self, system: System, x: ca.SX, u: ca.SX, outer: Params) -> tuple[ca.SX, ca.SX]:
        """Outputs and rates of a system."""
        self._declared |= set(getattr(system, "params", None) or {})
        if isinstance(system, ct.InterconnectedSystem):
            return self._of_interconnection(system, x, u, {**system.params, **outer})
        traits = traits_of(system)
        for what, found in (("samples", traits.period), ("a delay", traits.delay)):
            if found is not None:
                raise ValueError(f"equations must be those of a continuous plant, got {what} in block {system.name}")
        own = {} if isinstance(system, ct.StateSpace) else {**system.params, **outer, **self._params}
        trace = self._trace(_Block(system, own))
        _check_time(trace, system)
        column = ca.vertcat(ca.SX(0, 1), *(self._symbol(name, own[name]) for name in trace.symbols))
        return trace.output(0.0, x, u, column), trace.update(0.0, x, u, column)

    def _symbol(self, name: str, value: float) -> ca.SX:
        if name not in self.symbols:
            self.symbols[name], self.values[name] = Symbol(ca.SX.sym(name)), float(value)
        elif self.values[name] != value:  # two blocks with different parameters of one name
            return ca.SX(float(value))
        return self.symbols[name].sx

    def _trace(self, block: _Block) -> Trace:
        system = block.system
        # Ones, not zeros: many equations are infinite where all states are 0.
        near = [
            np.array([self._guess.get(name, 1.0) for name in labels])
            for labels in (system.state_labels or [], system.input_labels or [])
        ]
        return traced(block, block.params, 0.0, *near)

    def _of_interconnection(self, system: System, x: ca.SX, u: ca.SX, outer: Params) -> tuple[ca.SX, ca.SX]:
        """Outputs and rates of an interconnection, its connections resolved by substitution."""
        signals = [ca.SX.sym(str(block.name), block.noutputs) for block in system.syslist]
        everything = ca.vertcat(*signals)
        given = _dense(system.connect_map) @ everything + _dense(system.input_map) @ u
        outputs, rates, state, first = [], [], 0, 0
        for block in system.syslist:
            n, m = block.nstates or 0, block.ninputs or 0
            found = self.of(block, x[state : state + n], given[first : first + m], outer)
            outputs.append(found[0])
            rates.append(found[1])
            state, first = state + n, first + m
        solved = _resolved(everything, ca.vertcat(*outputs), system)
        result = _dense(system.output_map) @ ca.vertcat(everything, given)
        return ca.substitute(result, everything, solved), ca.substitute(ca.vertcat(*rates), everything, solved)


def _dense(matrix: Value) -> ca.DM:
    return ca.sparsify(ca.DM(np.asarray(matrix, dtype=float)))


def _resolved(signals: ca.SX, outputs: ca.SX, system: System) -> ca.SX:
    """Outputs of the blocks without references to each other."""
    if ca.depends_on(outputs, signals) and not _is_nilpotent(outputs, signals):
        through = ca.jacobian(outputs, signals)
        if ca.depends_on(through, signals):
            names = [label for block in system.syslist for label in (f"{block.name}.{o}" for o in block.output_labels)]
            loop = sorted({names[k] for k in _cyclic(through)})
            raise ValueError(
                f"system must have no algebraic loop that is nonlinear in its signals, got one of {', '.join(loop)} "
                f"in {system.name}; solve it in the equations of one block"
            )
        constant = ca.substitute(outputs, signals, ca.SX.zeros(signals.numel()))
        return ca.solve(ca.SX.eye(signals.numel()) - through, constant)
    while ca.depends_on(outputs, signals):  # the paths through signals become half as long
        outputs = ca.substitute(outputs, signals, outputs)
    return outputs


def _is_nilpotent(outputs: ca.SX, signals: ca.SX) -> bool:
    """Whether no output depends on itself through the others."""
    return not _cyclic(ca.jacobian(outputs, signals))


def _cyclic(through: ca.SX) -> list[int]:
    """Signals that depend on themselves."""
    pattern = np.zeros(through.shape, dtype=bool)
    rows, columns = through.sparsity().get_triplet()
    pattern[rows, columns] = True
    reached = pattern.copy()
    for _ in range(len(pattern)):
        reached |= (reached.astype(int) @ pattern.astype(int)) > 0
    return np.flatnonzero(reached.diagonal()).tolist()


def _check_time(trace: Trace, system: System) -> None:
    """Raise if the equations depend explicitly on time."""
    for function, labels, what in (
        (trace.update, system.state_labels, "the rate of"),
        (trace.output, system.output_labels, "output"),
    ):
        rows = function.jac_sparsity(0, 0).get_triplet()[0] if labels else []
        if rows:
            raise ValueError(
                f"equations must not depend on time, got {what} {labels[rows[0]]} of block {system.name}, which does"
            )
