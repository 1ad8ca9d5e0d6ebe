"""Draws the figure of the README: the servo of its first program, stepped and planned.

``python3 tests/support/readme_figure.py`` writes notebooks/step_versus_planned.svg.
The loop, the plan and the times are those of the program in the README, which
is run here.
"""

import re
from pathlib import Path

import control as ct
import matplotlib as mpl
import matplotlib.pyplot as plt

import ctrlplan as cp

ROOT = Path(__file__).parents[2]
FILE = ROOT / "notebooks" / "step_versus_planned.svg"
STEP, PLANNED, REFERENCE = "#D55E00", "#0072B2", "#777777"  # of Okabe and Ito, told apart by colour-blind readers
SUPPLY = 24.0  # V
STYLE = {"font.size": 9.0, "axes.spines.top": False, "axes.spines.right": False}


def program():
    """Return the first program of the README."""
    return re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)[1]


def figure():
    """Angle and voltage of the motor over time."""
    names = {}
    head = program().split("result =")[0]
    exec(head, names)
    loop, voltage = names["loop"], ct.feedback(names["C"], names["P"])
    plans, t = {"step": cp.Step(1.0), "planned": names["plan"]}, names["t"]
    with mpl.rc_context(STYLE):
        drawn, (left, right) = plt.subplots(1, 2, figsize=(8.0, 2.9), layout="constrained")
        left.plot(t, plans["planned"](t), color=REFERENCE, ls=(0, (4, 2)), lw=1.0, label="planned reference")
        for (name, plan), colour in zip(plans.items(), (STEP, PLANNED), strict=True):
            style = {"color": colour, "lw": 1.8, "ls": "-" if name == "planned" else "-."}
            left.plot(t, cp.simulate(loop, t, plan).outputs, label=f"response to the {name} reference", **style)
            right.plot(t, cp.simulate(voltage, t, plan).outputs, **style)
        left.axhline(1.0, color=REFERENCE, lw=0.6)
        left.set(xlabel="time [s]", ylabel="angle [rad]", xlim=(0.0, 0.4), ylim=(0.0, 1.5))
        left.legend(frameon=False, loc="lower right", fontsize=8.0)
        right.axhspan(-SUPPLY, SUPPLY, color="#eeeeee", zorder=0)
        peak = float(abs(cp.simulate(voltage, t, plans["step"]).outputs).max())
        right.annotate(
            f"{peak:.0f} V at 0 s",
            (0.002, 98.0),
            (0.05, 80.0),
            color=STEP,
            arrowprops={"arrowstyle": "->", "color": STEP},
        )
        right.text(0.4, SUPPLY - 3.0, "±24 V supply", ha="right", va="top", color="#555555", fontsize=8.0)
        right.set(xlabel="time [s]", ylabel="motor voltage [V]", xlim=(-0.005, 0.4), ylim=(-60.0, 100.0))
    return drawn


def main():
    mpl.use("svg")
    with mpl.rc_context({"svg.hashsalt": "ctrlplan"}):
        figure().savefig(FILE, metadata={"Date": None})
    print(FILE)


if __name__ == "__main__":
    main()
