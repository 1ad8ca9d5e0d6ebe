"""Computes the values of golden_hermite.json again, in 250 digits.

``python3 tests/trajectories/make_golden_hermite.py`` writes the file, and says
how many of its numbers have changed. The cases themselves (waypoints with
their derivatives, alpha, query times) were drawn at random once, with three
decimals, and stand in the file. Values are those of equation (2) of the paper,
with gamma the mean of the constraints' abscissae, its coefficients found from
(3) by elimination; with alpha = 0 those of the polynomial (12). Each digit
lost to the condition of (3) is paid for by the 250.
"""

import json
import sys
from pathlib import Path

FILE = Path(__file__).with_name("golden_hermite.json")
DIGITS = 250


def values(case):
    """Derivatives 0 to 3 at the query times, as lists [nu][time]."""
    from trajectory_oracle import Direct  # of tests/support, which pytest has on its path

    times, jets = zip(*case["points"], strict=True)
    return Direct(times, jets, case["alpha"], digits=DIGITS).jet(case["times"], 3).tolist()


def main():
    sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
    cases = json.loads(FILE.read_text())
    made = [case | {"values": values(case)} for case in cases]
    pairs = [
        (old, new)
        for before, after in zip(cases, made, strict=True)
        for rows in zip(before["values"], after["values"], strict=True)
        for old, new in zip(*rows, strict=True)
    ]
    print(f"{sum(old != new for old, new in pairs)} of {len(pairs)} numbers have changed")
    FILE.write_text(json.dumps(made))


if __name__ == "__main__":
    main()
