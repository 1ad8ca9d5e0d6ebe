"""Study files as plain data, and as TOML."""

import copy
import json
import math

VALID = {
    "title": "Over the wall",
    "t_end": 30.0,
    "samples": 101,
    "units": {"x": "m", "u": "N"},
    "loop": {"kind": "linear", "num": [1.0], "den": [1.0, 1.0, 0.0], "gain": 5.0},
    "plans": [
        {"name": "trigonometric", "family": "trigonometric", "alpha": 2.0},
        {"name": "poly", "family": "polynomial"},
        {"name": "legs", "family": "piecewise", "alpha": 0.5},
        {"name": "step", "family": "step"},
    ],
    "waypoints": [
        {"time": 0.0, "x": [0.0, 0.0, 0.0]},
        {"time": 6.0, "x": [5.0, 1.0, 0.0]},
        {"time": 16.0, "x": [20.0, 0.0, 0.0]},
    ],
}


def valid(**changes):
    """Return a deep copy of a valid file's data, some entries changed."""
    return {**copy.deepcopy(VALID), **changes}


class Verbatim(str):
    """Text that stands in the file as it is: a date, a float that is written otherwise."""

    __slots__ = ()


def to_toml(data):
    """Return data as TOML: entries, then tables, then tables in lists."""
    entries = [(k, v) for k, v in data.items() if not (isinstance(v, dict) or _tables(v))]
    lines = [f"{_key(k)} = {_value(v)}" for k, v in entries]
    for key, value in data.items():
        if isinstance(value, dict):
            lines += ["", f"[{_key(key)}]", *(f"{_key(k)} = {_value(v)}" for k, v in value.items())]
        elif _tables(value):
            for table in value:
                lines += ["", f"[[{_key(key)}]]", *(f"{_key(k)} = {_value(v)}" for k, v in table.items())]
    return "\n".join(lines) + "\n"


def _tables(value):
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)


def _key(key):
    return json.dumps(key, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value):
    if isinstance(value, Verbatim):
        return str(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return (
            ("nan" if math.isnan(value) else "inf" if value > 0 else "-inf")
            if not math.isfinite(value)
            else repr(value)
        )
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_key(k)} = {_value(v)}' for k, v in value.items())}}}"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
