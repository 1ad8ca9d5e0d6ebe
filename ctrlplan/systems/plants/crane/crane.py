"""Crane of the paper's section 5: trolley, hoist and a load on a rope."""

from __future__ import annotations

from collections.abc import Iterator

from ctrlplan._display import Facts, Part
from ctrlplan.systems.plants.crane import flatness, linear, model, rope
from ctrlplan.systems.plants.crane.parameters import CraneParameters
from ctrlplan.systems.plants.parameters import parameters_of
from ctrlplan.systems.plants.plant import Plant


class Crane(CraneParameters, Plant):
    """Crane with trolley, drum and a load on a rope.

    Equations, flat maps, linear models and PIDs are methods. z points down.
    Equation numbers in the methods refer to the paper.

    Parameters
    ----------
    load_mass : float
        m [kg].
    trolley_mass : float
        M_c [kg].
    drum_inertia : float
        J [kg m^2].
    drum_radius : float
        b [m].
    trolley_friction : float
        f1 [N s/m].
    drum_friction : float
        f2 [N m s].
    gravity : float
        g [m/s^2].
    rope_wrap : bool
        False: (14b) of the paper, which neglects that the rope winds on the drum
        as theta changes. True: with that term; the model then conserves energy.

    Raises
    ------
    ValueError
        If a mass, the inertia, the radius or gravity is not above 0, or a
        friction is negative.

    Examples
    --------
    >>> crane = Crane(load_mass=500.0)
    >>> state, inputs = crane.equilibrium(x=0.0, z=10.0)
    >>> inputs.tolist()
    [0.0, -1226.25]
    """

    title, name = "Crane", "crane"
    signals = model.SIGNALS

    # The nonlinear plant: model.py
    iosystem = model.iosystem
    equilibrium = model.equilibrium
    accelerations = model.accelerations
    energy = model.energy

    # Flat maps and checks of a plan: flatness.py, rope.py
    closed_form = flatness.closed_form
    quantities = flatness.quantities
    check = flatness.check
    rope = rope.rope

    # Linear models and controllers of the study: linear.py
    linear_trolley = linear.linear_trolley
    linear_hoist = linear.linear_hoist
    linear_coupled = linear.linear_coupled
    trolley_pid = linear.trolley_pid
    hoist_pid = linear.hoist_pid
    linear_trolley_loop = linear.linear_trolley_loop
    linear_hoist_loop = linear.linear_hoist_loop

    def _describe(self) -> Iterator[Part]:
        yield f"Crane with a load of {self.load_mass:g} kg"
        rows = [
            (entry.name.replace("_", " "), f"{getattr(self, entry.name):g} {entry.metadata['unit']}")
            for entry in parameters_of(self)
        ]
        yield Facts([*rows, ("rope winding with theta", "included" if self.rope_wrap else "neglected")])
        yield "Flat outputs: x and z of the load. Inputs: force F [N] of the trolley and torque C [N m] of the drum."
