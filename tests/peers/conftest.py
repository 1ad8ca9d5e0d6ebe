"""The whole comparison runs only with ``-m peers``: it takes minutes and is a separate step of CI."""

import pytest

collect_ignore = ["adapter.py", "comparison.py", "examples.py", "plugin.py"]  # imported in the other process alone


def pytest_configure(config):
    config.addinivalue_line("markers", "peers: all of python-control's tests and examples; runs by -m peers alone")


def pytest_collection_modifyitems(config, items):
    if "peers" not in config.getoption("markexpr", ""):
        skip = pytest.mark.skip(reason="minutes long, its own step of CI: python3 -m pytest tests/peers -m peers")
        for item in items:
            if item.get_closest_marker("peers"):
                item.add_marker(skip)
