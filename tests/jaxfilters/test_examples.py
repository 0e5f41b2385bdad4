"""The examples in the docstrings of the library run and print what they say."""

import doctest
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXTRAS = {
    "jaxfilters.motion.flow": "diffrax"
}  # packages that come with an extra, by the module whose examples use them
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in sorted((ROOT / "jaxfilters").rglob("*.py"))
    if ">>>" in path.read_text()
]


@pytest.mark.system
@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    if name in EXTRAS:
        pytest.importorskip(EXTRAS[name])
    failed, attempted = doctest.testmod(import_module(name))
    assert attempted > 0
    assert failed == 0


def test_there_are_examples():
    assert len(MODULES) > 30
