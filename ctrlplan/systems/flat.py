"""Tracking control of flat plants: linearisation by the flag of the flat output, then pole placement.

Equations (9)-(11) of the paper, (11) corrected: the sum starts at 0 and is subtracted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import control as ct
import control.flatsys as fs
import numpy as np
from numpy.typing import ArrayLike

from ctrlplan._checks import checked_labels
from ctrlplan._renamed import former_signature
from ctrlplan._types import Params, Value
from ctrlplan.flatness import FlatSystem
from ctrlplan.flatness.derived import DerivedFlatSystem
from ctrlplan.flatness.deriving import flat_system
from ctrlplan.flatness.verify import (
    check_linearises,
    check_output,
    checked_plant,
    finite_rows,
    flat_labels,
    planned_probes,
    random_probes,
)
from ctrlplan.systems.derived_laws import InputLimits, create_derived_law, references
from ctrlplan.systems.poles import checked_gains


@former_signature("name", renamed={"flat_system": "flat"})
def create_flat_iosystem(
    flat: fs.FlatSystem,
    poles: Sequence[Value],
    *,
    quasi_static: bool = False,
    integral: bool = False,
    start: ArrayLike | None = None,
    limits: InputLimits | None = None,
    labels: Sequence[str] | str | None = None,
    suffix: str = "_ref",
    name: str = "flat_law",
) -> ct.NonlinearIOSystem:
    r"""Tracking controller of a flat plant, (9)-(11) corrected.

    With y_1, ..., y_1^(r_1), y_2, ... the flag of the flat outputs,

    .. math:: v_j = y_{d,j}^{(r_j)} - \sum_{k=0}^{r_j - 1} \sigma_{j,k}\,(y_j^{(k)} - y_{d,j}^{(k)}),
        \qquad s^{r_j} + \sum_k \sigma_{j,k} s^k = \prod_k (s - p_{j,k}),

    and u is computed by `flat.reverse` from the flag with v_j in place of
    y_j^(r_j). The closed loop consists of chains of r_j integrators, in which
    the tracking errors satisfy the linear equation with the poles p_j.

    A plant that static feedback does not linearise (`FlatSystem.extension` above 0)
    gets a law with the states of the extension, w1, ..., which follow w' as the
    maps give it for v; or, with `quasi_static`, a law without states, which
    computes w from the states of the plant, the references, and the error
    equations of the outputs that are closed at a lower order.

    Inputs: for each flat output its references, y_ref, y_ref_d1, ...
    up to order r_j for one called y, as `create_source_iosystem` names its
    outputs with ``suffix="_ref"``; then the states of the plant by name.
    Outputs: the inputs of the plant by name, such as u. States: those of the extension
    and, with `integral`, the integrals of the errors.

    Parameters
    ----------
    flat : control.flatsys.FlatSystem
        Continuous-time plant, as `flat_system` returns it, or with maps of its own.
        These must linearise the plant by static feedback: the flag of flat output j
        has r_j + 1 entries, of which y_j, ..., y_j^(r_j - 1) are functions of the
        state only, and the sum of all r_j is the number of states. Otherwise, and
        for the other options, the law is derived from its equations (extra
        ``fast``), which must be functions of numpy.
    poles : sequence of sequences of complex
        Poles [rad/s] of the tracking error of each flat output, closed under
        conjugation, with negative real parts; a single sequence for a single flat
        output. As many as its order r_j, or with `quasi_static` as many as the
        order at which it is closed (their sum is the number of states of the
        plant; an error states the numbers); one more with `integral`.
    quasi_static : bool, optional
        Whether the law has no states of the extension. It is singular at more
        states than the law with them (heading at 90 degrees of a vehicle, for
        example). Default False.
    integral : bool, optional
        Whether the law contains the integral of each error, so that a constant
        disturbance leaves no constant error. Default False.
    start : array_like, shape (extension,), optional
        Initial states of the extension. Default: those at the operating point.
    limits : mapping of str to pair of float, optional
        Lower and upper limits of inputs of the plant by name, within which the
        outputs stay. States of the extension, and integrals of a law without
        `quasi_static`, are those of the limited inputs; where a limit of an input in
        place of which there is such a state is active, the other flat outputs still
        satisfy their error equations. Default: none.
    labels : sequence of str or str, optional
        Names of the flat outputs. Default: those that `flat` has or, for a flat
        system of python-control, the names of its outputs if these are the flat
        outputs, otherwise y, or y1, y2, ...
    suffix : str, optional
        Appended to each label in the names of the references.
    name : str, optional
        Name of the block.

    Returns
    -------
    control.NonlinearIOSystem
        In continuous time; static, of any time base, without states.

    Raises
    ------
    TypeError
        If `flat` is not a `control.flatsys.FlatSystem`, or poles or labels have
        the wrong type.
    ValueError
        If the maps of `flat` do not linearise it by static feedback, and its
        equations give no law either: a derivative below the last depends on an
        input (the message says which), the decoupling matrix is singular, or the
        flags are too short; if `forward`, `reverse` and the
        equations of the plant are inconsistent; if `flat` is a `LinearFlatSystem`
        with zeros, whose output is not a flat output, and `labels` is not given; or
        if poles or labels are wrong.

    Notes
    -----
    The maps are checked at a few states (random ones from a fixed seed, some
    from `reverse`, and the zero state unless it is singular); flatness elsewhere
    is not verified.

    The plant in the loop must have its states as outputs under their names, as
    the plants of `ctrlplan.plants` have. The flat output of a `LinearFlatSystem` is
    its output, of which that of python-control is a multiple; with zeros it is that
    of python-control, which `labels` must name. Its maps are computed here from its
    matrices in exact arithmetic.

    The controller uses the parameters that `flat` has when it is constructed; a
    simulation of the loop with other parameters shows the effect of model errors.

    Examples
    --------
    >>> import control as ct
    >>> import ctrlplan as cp
    >>> from ctrlplan.systems.plants.integrator_chain import integrator_chain
    >>> plan = cp.PolySpline([cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)])
    >>> chain = integrator_chain(2)
    >>> law = create_flat_iosystem(chain, poles=[-3, -4])
    >>> law.input_labels
    ['y_ref', 'y_ref_d1', 'y_ref_d2', 'y', 'y_d1']
    >>> loop = ct.interconnect(
    ...     [cp.create_source_iosystem(plan, 2, suffix="_ref"), law, chain], inputs=0, outputs=["y"]
    ... )
    >>> found = cp.simulate(loop, [0.0, 0.5, 1.0])
    >>> bool(abs(found.outputs - plan(found.time)).max() < 1e-7)
    True
    """
    derived = derived_system_of(flat, quasi_static or integral or limits is not None)
    if derived is not None:
        names = derived.flat_labels if labels is None else checked_labels(labels, len(derived.flat_labels))
        return create_derived_law(
            derived,
            poles,
            quasi_static=quasi_static,
            integral=integral,
            start=start,
            labels=names,
            suffix=suffix,
            name=name,
            limits=limits,
        )
    if start is not None:
        raise ValueError(f"start must be None for {flat.name}, whose law has no states of an extension")
    return _static_law(flat, poles, labels, suffix, name)


def _static_law(
    flat: fs.FlatSystem, poles: Sequence[Value], labels: Sequence[str] | str | None, suffix: str, name: str
) -> ct.NonlinearIOSystem:
    """Law of a plant that static feedback linearises, by its own maps."""
    plant = checked_plant(flat, "flat")
    if labels is None:
        check_output(flat)
        labels = flat.flat_labels if isinstance(flat, FlatSystem) else None
    probes = random_probes(plant)
    names = flat_labels(plant, probes, labels)
    check_linearises(plant, probes, names)
    planned = planned_probes(plant, probes[0].orders)
    check_linearises(plant, planned, names)
    orders = probes[0].orders
    gains = checked_gains(poles, orders)
    wanted = references(names, orders, suffix)
    states = list(plant.system.state_labels)
    if shared := sorted(set(wanted) & set(states)):
        raise ValueError(f"labels and suffix must not give references the names of states, got {', '.join(shared)}")
    idle = np.zeros(plant.ninputs)

    def law(t: float, x: Value, u: Value, params: Params) -> Value:
        # Entries of the flag below the last derivative do not depend on the input.
        measured = plant.forward(u[len(wanted) :], idle)
        flag, first = [], 0
        for row, sigma in zip(measured, gains, strict=True):
            r = len(sigma)
            desired = u[first : first + r + 1]
            v = desired[r] - sum(sigma[k] * (row[k] - desired[k]) for k in range(r))
            flag.append(np.array([*row[:r], v]))
            first += r + 1
        return plant.reverse(flag)[1]

    regular = np.concatenate([*planned[0].flag, planned[0].x])

    def law_off_zero(t: float, x: Value, u: Value, params: Params) -> Value:
        # Blocks are first evaluated with all inputs zero, where this plant is singular: the law is evaluated
        # at a regular state instead and multiplied by 0. Without a branch, so that it can be traced.
        idles = math.prod(value == 0.0 for value in u)
        moved = np.empty(regular.size, dtype=u.dtype)
        for i, at in enumerate(regular.tolist()):
            moved[i] = u[i] + idles * at
        return [value * (1.0 - idles) for value in law(t, x, moved, params)]

    zero = np.zeros(len(wanted) + plant.nstates)
    return ct.nlsys(
        None,
        law_off_zero if finite_rows(law, 0.0, None, zero, {}) is None else law,
        inputs=[*wanted, *states],
        outputs=list(plant.system.input_labels),
        dt=None,
        name=name,
    )


def derived_system_of(flat: fs.FlatSystem, options: bool) -> DerivedFlatSystem | None:
    """Flat system for which the law is derived from equations; None for static maps of its own."""
    if isinstance(flat, FlatSystem) and (options or flat.extension > 0 or isinstance(flat, DerivedFlatSystem)):
        return flat.derived
    if not options:
        return None
    plant = checked_plant(flat, "flat")
    return flat_system(flat, lambda x, u, params: [row[0] for row in plant.forward(x, u)])
