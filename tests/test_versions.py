"""Versions of other packages: whose deprecations fail a test, and which minima the matrix of versions pins."""

import importlib.util
import re
import warnings
from pathlib import Path

import pytest

MATRIX = Path(__file__).parent / "support" / "matrix.py"


def deprecated_in(module, category=DeprecationWarning):
    warnings.warn_explicit("an old name", category, f"{module}.py", 1, module=module)


@pytest.mark.parametrize(
    "module", ["control.nlsys", "control", "casadi.casadi", "matplotlib.rcsetup", "pyparsing.util"]
)
def test_a_deprecation_between_other_packages_fails_no_test(module):
    deprecated_in(module)


@pytest.mark.parametrize("module", ["ctrlplan", "ctrlplan.systems.pid", "test_versions", "controlled", "__main__"])
def test_a_deprecation_by_our_own_call_fails_its_test(module):
    with pytest.raises(DeprecationWarning, match="an old name"):
        deprecated_in(module)


def expected_beside(path):
    warnings.warn("expected", UserWarning, stacklevel=1)
    warnings.warn_explicit("an old name", DeprecationWarning, path, 1, module=path.split("/")[-1][:-3])


def test_nor_one_that_expects_another_warning():
    with pytest.warns(UserWarning, match="expected"):
        expected_beside("/home/user/lib/site-packages/control/statesp.py")
    with pytest.raises(DeprecationWarning), pytest.warns(UserWarning, match="expected"):
        expected_beside("/home/user/lib/site-packages/ctrlplan/systems/pid.py")


@pytest.mark.parametrize("category", [FutureWarning, RuntimeWarning, UserWarning])
def test_every_other_warning_fails_its_test(category):
    """python-control's deprecations are FutureWarnings: they are about the call, which is ours."""
    with pytest.raises(category, match="an old name"):
        deprecated_in("control.timeresp", category)


def test_the_matrix_pins_the_declared_minima():
    spec = importlib.util.spec_from_file_location("matrix", MATRIX)
    matrix = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(matrix)
    pins = dict(pin.split("==") for pin in matrix.minima())
    assert set(pins) == {"control", "numpy", "scipy", "matplotlib", "jinja2", "tqdm", "casadi", "mpmath"}
    assert all(re.fullmatch(r"\d+(\.\d+)+", pin) for pin in pins.values())
