"""Methods of simulation, one file each."""

from ctrlplan.simulation.methods.compiled import CompiledMethod
from ctrlplan.simulation.methods.delegated import Delegated
from ctrlplan.simulation.methods.discrete import Discrete
from ctrlplan.simulation.methods.exact import Exact
from ctrlplan.simulation.methods.method import Method, applicable, named, recorded
from ctrlplan.simulation.methods.python import Python

__all__ = [
    "METHODS",
    "CompiledMethod",
    "Delegated",
    "Discrete",
    "Exact",
    "Method",
    "Python",
    "applicable",
    "named",
    "recorded",
]

METHODS: tuple[Method, ...] = (
    Exact(),
    CompiledMethod(),
    Python(),
    Discrete(),
    Delegated(),
)
"""Methods in the order of "auto". A new method is one more line."""
