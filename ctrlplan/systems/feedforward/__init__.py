"""Feedforward of linear loops: the command with which a loop follows a plan exactly.

`create` has the public function; `inverse` finds the relative degrees and the internal dynamics of a loop, `zeros`
separates these by their stability, `states` integrates them along a plan, `preview` finds how long before the plan a
command starts. `planned` and `discrete` put the command of one plan together, with `reference` and `sampled` for loops
with sample times; `block` is the source that has it.
"""

from ctrlplan.systems.feedforward.block import PlannedFeedforward
from ctrlplan.systems.feedforward.create import create_feedforward_iosystem

__all__ = ["PlannedFeedforward", "create_feedforward_iosystem"]
