"""Plans as ROS messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctrlplan.trajectories.export.formats import Files, Format, Options, decimals
from ctrlplan.trajectories.trajectory import Trajectory

_FIELDS = ("positions", "velocities", "accelerations")


class JointTrajectory(Format):
    """YAML of the message trajectory_msgs/JointTrajectory (ROS 2).

    Joints are the axes; times count from the plan's start, in whole
    nanoseconds. ``effort`` are the inputs of the flat system, in their order.
    """

    accepted = ("dt", "timepts", "derivatives", "flat")

    def files(self, plan: Trajectory, path: Path, options: Options) -> Files:
        """Contents by path; as `Format.files`."""
        if options.derivatives >= len(_FIELDS):
            raise ValueError(
                f"derivatives must be at most 2 in a JointTrajectory, which has no jerk, got {options.derivatives}"
            )
        times = options.times(plan.start, plan.end)
        since = np.rint((times - plan.start) * 1e9)
        if since.size and (since[0] < 0 or (np.diff(since) <= 0).any()):
            raise ValueError(
                f"times of a JointTrajectory must increase by at least 1 ns from the plan's start at {plan.start:g} s "
                f"on, got {times[0]:g} s to {times[-1]:g} s with a difference of {np.diff(times).min(initial=0.0):g} s"
            )
        values = dict(zip(_FIELDS, plan.jet(times, options.derivatives), strict=False))
        if options.flat is not None:
            values["effort"] = options.flat.states_and_inputs(plan, times)[1]
            if len(values["effort"]) != plan.naxes:
                raise ValueError(
                    f"inputs of the flat system must be one per axis in a JointTrajectory, {plan.naxes}, got "
                    f"{len(values['effort'])}: {', '.join(options.flat.input_labels)}"
                )
        lines = [f"joint_names: [{', '.join(map(_quoted, plan.labels))}]", "points:" if times.size else "points: []"]
        for k, nanoseconds in enumerate(since.tolist()):
            rows = [f"{name}: [{decimals(value[:, k])}]" for name, value in values.items()]
            sec, nanosec = divmod(int(nanoseconds), 1_000_000_000)
            rows.append(f"time_from_start: {{sec: {sec}, nanosec: {nanosec}}}")
            lines += ["  - " + rows[0], *("    " + row for row in rows[1:])]
        return {path: "\n".join(lines) + "\n"}


def _quoted(name: str) -> str:
    """Text between quotation marks of YAML."""
    plain = (c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in name)
    return f'"{"".join(plain)}"'
