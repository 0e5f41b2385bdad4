"""The direction of imports, read from the source: trackers and shell -> models -> the core, never back."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = {"jaxfilters": 0, "models": 1, "trackers": 2, "benchmarks": 3}
"""Folders, lowest first; each may import itself and what is below."""
MODULE_NAMES = {"opencv-python-headless": "cv2", "lazy-loader": "lazy_loader"}
"""Where a distribution is not imported by its own name."""

SOURCES = sorted(path for folder in LAYERS for path in (ROOT / folder).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))


def imported(path):
    """The dotted names that a file imports anywhere in it; relative imports keep their leading dots."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            names += [f"{module}.{alias.name}" for alias in node.names]
    return names


def layer(name):
    """Layer of an import name, or None for what is not ours."""
    first, *rest = name.split(".")
    if first != "jaxfilters":
        return None
    return LAYERS[rest[0]] if rest and rest[0] in LAYERS else 0


def dependencies(*extras):
    """Import names of the declared requirements, with those of the extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [project["dependencies"], *(project["optional-dependencies"][extra] for extra in extras)]
    distributions = [re.split(r"[^\w-]", requirement)[0] for group in groups for requirement in group]
    return {MODULE_NAMES.get(name, name) for name in distributions}


def relative_name(path):
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_imports_run_downwards(path):
    here = LAYERS[path.relative_to(ROOT).parts[0]]
    upwards = [name for name in imported(path) if (layer(name) or 0) > here]
    assert not upwards


@pytest.mark.parametrize("path", sorted((ROOT / "trackers").glob("*.py")), ids=relative_name)
def test_trackers_know_nothing_of_the_shell_around_them(path):
    assert not [name for name in imported(path) if name.startswith("jaxfilters.trackers.shell")]


@pytest.mark.parametrize("path", SOURCES + TESTS, ids=relative_name)
def test_our_modules_have_one_name(path):
    """`import models.camera` in a checkout would load a second copy of the module, with other classes."""
    others = [name for name in imported(path) if name.split(".")[0] in {"", "models", "trackers", "benchmarks"}]
    assert not others


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_every_import_is_declared(path):
    """The library runs without extras; only benchmarks may use theirs."""
    extras = ("bench",) if path.relative_to(ROOT).parts[0] == "benchmarks" else ()
    known = dependencies(*extras) | set(sys.stdlib_module_names) | {"jaxfilters"}
    assert {name.split(".")[0] for name in imported(path)} <= known


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_jaxopt_is_imported_where_it_is_used(path):
    """Its import warns; nobody who does not use it should see that."""
    at_the_top = [n for n in ast.parse(path.read_text()).body if isinstance(n, ast.Import | ast.ImportFrom)]
    assert "jaxopt" not in " ".join(map(ast.unparse, at_the_top))


def test_the_reader_of_imports_sees_all_forms(tmp_path):
    (tmp_path / "a.py").write_text(
        "import os.path, jaxfilters.models\nfrom . import b\nfrom jaxfilters import trackers\n"
        "def f():\n    from jaxfilters.models.camera import Pinhole\n"
    )
    found = imported(tmp_path / "a.py")
    assert sorted(found) == sorted(
        ["os.path", "jaxfilters.models", "..b", "jaxfilters.trackers", "jaxfilters.models.camera.Pinhole"]
    )
    assert [layer(name) for name in found] == [None, 1, None, 2, 1]
