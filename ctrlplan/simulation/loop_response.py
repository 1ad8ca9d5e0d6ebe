"""Signals of a loop along one plan: the interface of exact and simulated responses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

from ctrlplan._display import Displayed, Facts, Part
from ctrlplan._types import Array
from ctrlplan.simulation.prepared import Prepared


def signal_names(prepared: Prepared) -> tuple[str, ...]:
    """Names of the signals of a loop: outputs, then inputs that have other names."""
    outputs = prepared.output_labels
    return (*outputs, *(label for label in prepared.input_labels if label not in outputs))


class LoopSignals(Displayed):
    """Signals of a loop along plans; base class.

    Parameters
    ----------
    prepared : Prepared
        The loop.

    Attributes
    ----------
    name : str
        Name of the loop.
    names : tuple of str
        Names of its signals: outputs, then inputs that have other names.
    inputs : tuple of str
        Names of its inputs in order.
    """

    kind: ClassVar[str]
    """How responses are computed, in a word."""

    def __init__(self, prepared: Prepared) -> None:
        self._prepared, self.name = prepared, prepared.name
        self.inputs = tuple(prepared.input_labels)
        self.names = signal_names(prepared)

    def _describe(self) -> Iterator[Part]:
        yield f"Signals of {self.name} along a plan: {', '.join(self.names)}"
        yield Facts([("inputs", ", ".join(self.inputs)), ("response", self.kind)])


@dataclass(frozen=True)
class Extremes:
    """Minimum and maximum of a signal of a loop along a plan, and their times.

    Attributes
    ----------
    low, high : float
        Minimum and maximum, in the unit of the signal.
    time_low, time_high : float
        Times [s] at which they are attained, of the plan; inf for the final
        value, which is approached.
    """

    low: float
    high: float
    time_low: float
    time_high: float


class LoopResponse(ABC):
    """Signals of a loop along one plan; returned by `LoopQuantities.quantities_of`.

    A new kind of response must define `extremes`, `rms`, `ends` and `values`, and
    have the attributes.

    Attributes
    ----------
    names : tuple of str
        Names of the signals: inputs, outputs and exposed states of the loop.
    note : str
        How the response was computed: "exact", or "simulated at tolerance 1e-08,
        over 4 s".
    """

    names: tuple[str, ...]
    note: str

    @abstractmethod
    def extremes(
        self,
        weights: Mapping[str, float],
        *,
        during: tuple[float, float] | None = None,
        rate: bool = False,
        line: tuple[float, float] | None = None,
    ) -> Extremes:
        """Minimum and maximum of a weighted sum of signals.

        Parameters
        ----------
        weights : mapping of str to float
            Factors by the name of a signal: one name for a signal, several for an
            edge of a region.
        during : (float, float), optional
            First and last time [s], in the time of the plan. Default: all times,
            from rest before the plan to the steady state after it.
        rate : bool, optional
            Of the time derivative of the sum instead, in its unit per second.
        line : (float, float), optional
            Values at the times of `during` of a linear function of time that is
            subtracted.

        Raises
        ------
        ValueError
            If a name is unknown, or the sum jumps and its derivative is requested.
        """

    @abstractmethod
    def rms(self, name: str, period: float | None = None) -> float:
        """Root of the mean square of a signal from the start of the plan.

        Parameters
        ----------
        name : str
            Signal.
        period : float, optional
            Length of the interval [s], dwell after the plan included. Default: the
            duration of the plan.

        Returns
        -------
        float
            In the unit of the signal.
        """

    @abstractmethod
    def ends(self, weights: Mapping[str, float]) -> tuple[float, float]:
        """Values of a weighted sum at rest before the plan and in steady state after it.

        Parameters
        ----------
        weights : mapping of str to float
            Factors by the name of a signal.

        Returns
        -------
        (float, float)
            In the unit of the sum; nan where the steady state is not known.
        """

    @abstractmethod
    def values(self, weights: Mapping[str, float], times: Array, *, rate: bool = False) -> Array:
        """Weighted sum of signals from the start of the plan on, for figures.

        Parameters
        ----------
        weights : mapping of str to float
            Factors by the name of a signal.
        times : ndarray, shape (ntime,)
            Times [s], from the start of the plan on; a simulated response is constant
            after its last time.
        rate : bool, optional
            Of the time derivative of the sum instead.

        Returns
        -------
        ndarray, shape (ntime,)
        """
