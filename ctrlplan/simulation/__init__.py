"""Responses of loops: exact where they are linear."""

from ctrlplan.simulation.simulate import rest_state, simulate, state_space, unstable_poles

__all__ = ["rest_state", "simulate", "state_space", "unstable_poles"]
