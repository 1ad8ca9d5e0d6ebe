"""Old names: the warning, whose line it names, and that both names together are an error."""

import inspect
import re
import warnings

import pytest

from ctrlplan._renamed import renamed_argument, warn_renamed


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
    with pytest.raises(TypeError, match=re.escape("only= is the old name of measures=")):
        renamed_argument("only", ("a",), "measures", ("a",))
