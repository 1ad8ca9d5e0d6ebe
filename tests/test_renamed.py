"""Old names: the warning, whose line it names, and that both names together are an error."""

import inspect
import re
import warnings

import pytest

import ctrlplan as cp
from ctrlplan import planning, reports
from ctrlplan._renamed import renamed_argument, warn_renamed

MOVE = [cp.Waypoint(0, 0, 0, 0), cp.Waypoint(1, 1, 0, 0)]
PLANE = cp.stack([cp.PolySpline(MOVE, labels=[name]) for name in "xz"])


def package_function(depth):
    """A function that warns, called through `depth` functions whose module is one of the package's."""
    module = {"__name__": "ctrlplan.somewhere", "warn_renamed": warn_renamed}
    exec("def f0():\n    warn_renamed('old=', 'new=')", module)
    for k in range(1, depth):
        exec(f"def f{k}():\n    f{k - 1}()", module)
    return module[f"f{depth - 1}"]


@pytest.mark.parametrize("depth", [1, 2, 5])
def test_the_warning_names_the_line_outside_the_package(depth):
    call = package_function(depth)
    with pytest.warns(FutureWarning, match="^old= is deprecated.*; use new=$") as caught:
        call()
    line = inspect.currentframe().f_lineno - 1
    assert [(w.filename, w.lineno) for w in caught] == [(__file__, line)]


def test_an_old_keyword_is_read_with_a_warning():
    with pytest.warns(FutureWarning, match=re.escape("only= is deprecated")):
        assert renamed_argument("only", ("a",), "measures", None) == ("a",)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert renamed_argument("only", None, "measures", ("b",)) == ("b",)
        assert renamed_argument("only", None, "measures", None) is None


def test_both_names_together_are_an_error():
    with pytest.raises(TypeError, match=re.escape("only= is the deprecated name of measures=")):
        renamed_argument("only", ("a",), "measures", ("a",))


OLD_NAMES = [
    (lambda: cp.PiecewiseSpline(MOVE), "legs", "segments"),
    (lambda: cp.clearance(PLANE, [cp.Disc((9.0, 0.0), 1.0)]), "least", "minimum"),
    (lambda: cp.fastest(cp.PolySpline(MOVE), {"velocity": 1.0}), "refusal", "rejection"),
    (lambda: reports, "plot_rivals", "plot_baselines"),
    (lambda: cp.margins(cp.PolySpline(MOVE), {"velocity": 9.0}), "hold", "satisfied"),
    (lambda: planning, "path_length", "plan_length"),
    (lambda: planning, "wandering", "plan_excess_length"),
]


@pytest.mark.parametrize(("made", "old", "new"), OLD_NAMES, ids=[f"{old}-{new}" for _, old, new in OLD_NAMES])
def test_an_old_name_of_a_member_gives_the_new_one_with_a_warning(made, old, new):
    thing = made()
    with pytest.warns(FutureWarning, match=rf"{old} is deprecated.*use .*{new}$"):
        found = getattr(thing, old)
    assert found is getattr(thing, new)
    assert old not in getattr(thing, "__all__", ())


def test_a_name_that_never_was_is_an_error():
    with pytest.raises(AttributeError, match=r"module .ctrlplan\.planning. has no attribute .wander."):
        planning.wander  # noqa: B018
