"""The examples in the docstrings of the library run and print what they say, and every function has one."""

import doctest
import inspect
import re
from importlib import import_module
from pathlib import Path
from pydoc import locate

import pytest

ROOT = Path(__file__).parents[2]
EXTRAS = {
    "jaxfilters.motion.flow": "diffrax",
    "jaxfilters.plot": "matplotlib",
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


def functions_of_the_reference():
    """Functions by name: the entries of docs/api, and what the modules among these entries define and show."""
    settings = (ROOT / "mkdocs.yml").read_text()
    hidden = re.compile("|".join(re.findall(r'"!([^"]+)"', settings)))
    for page in (ROOT / "docs" / "api").glob("*.md"):
        for entry in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE):
            found = locate(entry)
            members = vars(found) if inspect.ismodule(found) else {entry.rpartition(".")[2]: found}
            for name, member in members.items():
                is_own = not inspect.ismodule(found) or getattr(member, "__module__", "") == found.__name__
                if inspect.isroutine(member) and is_own and not hidden.search(name):
                    yield f"{entry}: {name}", member


def test_every_function_of_the_reference_has_an_example():
    functions = dict(functions_of_the_reference())
    assert len(functions) > 200
    assert not [name for name, function in functions.items() if ">>>" not in (inspect.getdoc(function) or "")]
