"""Rules that hold for every file, read from the source."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("jaxfilters", "models", "trackers", "benchmarks")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
LIBRARY = [path for path in SOURCES if path.relative_to(ROOT).parts[0] in ("jaxfilters", "models")]
TESTS = sorted((ROOT / "tests").rglob("*.py"))
BEFORE_THE_KEY = {"self", "cls", "filter", "params", "model"}
"""What a function belongs to may stand before the random key; nothing else."""
LONGEST_FILE, LONGEST_FUNCTION = 400, 60
Function = ast.FunctionDef | ast.AsyncFunctionDef


def parsed(path):
    return ast.parse(path.read_text())


def functions(tree):
    return [node for node in ast.walk(tree) if isinstance(node, Function)]


def relative_name(path):
    return str(path.relative_to(ROOT))


def positional(function):
    return [argument.arg for argument in (*function.args.posonlyargs, *function.args.args)]


def misplaced_keys(tree):
    """Public functions whose random key is not first, or has a default."""
    wrong = []
    for function in functions(tree):
        arguments = positional(function)
        names = {*arguments, *(argument.arg for argument in function.args.kwonlyargs)}
        if function.name.startswith("_") or "key" not in names:
            continue
        first = "key" in arguments and set(arguments[: arguments.index("key")]) <= BEFORE_THE_KEY
        has_default = first and len(arguments) - arguments.index("key") <= len(function.args.defaults)
        if not first or has_default:
            wrong.append(function.name)
    return wrong


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_a_random_key_comes_first_and_has_no_default(path):
    assert not misplaced_keys(parsed(path))


@pytest.mark.parametrize("path", LIBRARY, ids=relative_name)
def test_the_library_makes_no_random_key_and_changes_no_setting(path):
    calls = [ast.unparse(node) for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
    forbidden = ("jax.random.key(", "jax.random.PRNGKey(", "random.key(", "PRNGKey(", "jax.config.update(", "print(")
    assert not [call for call in calls if call.startswith(forbidden)]


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_annotations_are_evaluated(path):
    """With postponed annotations the shape checks of jaxtyping would see strings."""
    assert "from __future__ import annotations" not in path.read_text()


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_public_names_have_a_docstring(path):
    if path.name == "__main__.py":
        return
    tree = parsed(path)
    public = [n for n in tree.body if isinstance(n, Function | ast.ClassDef) and not n.name.startswith("_")]
    assert not [node.name for node in public if not ast.get_docstring(node)]
    assert ast.get_docstring(tree), "the module has no docstring"


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_files_and_functions_can_be_read(path):
    assert path.stem not in {"utils", "helpers", "common", "misc"}
    assert len(path.read_text().splitlines()) <= LONGEST_FILE
    long = {f.name: f.end_lineno - f.lineno + 1 for f in functions(parsed(path))}
    assert not {name: lines for name, lines in long.items() if lines > LONGEST_FUNCTION}


def uncollected(path):
    """Functions of a test file that neither pytest nor anything in the file or its conftest uses."""
    tree = parsed(path)
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    used |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    found = []
    for function in [node for node in tree.body if isinstance(node, Function)]:
        is_fixture = any("fixture" in ast.unparse(decorator) for decorator in function.decorator_list)
        is_collected = function.name.startswith(("test_", "pytest_")) or is_fixture
        if not is_collected and function.name not in used:
            found.append(function.name)
    return found


@pytest.mark.parametrize("path", TESTS, ids=relative_name)
def test_every_function_of_the_tests_is_collected_or_used(path):
    if path.name.startswith("test_"):
        assert not uncollected(path)


@pytest.mark.parametrize("path", TESTS, ids=relative_name)
def test_no_test_hides_another_of_the_same_name(path):
    names = Counter(node.name for node in parsed(path).body if isinstance(node, Function | ast.ClassDef))
    assert not [name for name, count in names.items() if count > 1]


@pytest.mark.parametrize("path", TESTS, ids=relative_name)
def test_files_with_tests_are_collected(path):
    has_tests = any(function.name.startswith("test_") for function in functions(parsed(path)))
    assert not has_tests or path.name.startswith("test_")


def unfailing(path):
    """Tests that neither assert, expect an error nor call a check, themselves or through a function of their file."""
    asserting = ("assert", "raises", "fail(", "check_")
    texts = {function.name: ast.unparse(function) for function in functions(parsed(path))}
    asserting += tuple(
        f"{name}("
        for name, text in texts.items()
        if not name.startswith("test_") and any(word in text for word in asserting)
    )
    return [n for n, text in texts.items() if n.startswith("test_") and not any(w in text for w in asserting)]


@pytest.mark.parametrize("path", TESTS, ids=relative_name)
def test_every_test_can_fail(path):
    assert not unfailing(path)


def test_the_rules_above_notice_what_they_forbid(tmp_path):
    bad = ast.parse("def f(x, key): ...\ndef g(key=None): ...\ndef h(*, key): ...\ndef ok(params, key, x=1): ...")
    assert misplaced_keys(bad) == ["f", "g", "h"]
    (tmp_path / "test_a.py").write_text("def tset_typo(): assert f()\ndef f(): ...\ndef test_it(): ...")
    assert uncollected(tmp_path / "test_a.py") == ["tset_typo"]
    assert unfailing(tmp_path / "test_a.py") == ["test_it"]
