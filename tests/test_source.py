"""Rules that hold for every file, read from the source. A test lists all offenders of its rule at once."""

import ast
import functools
import importlib
import importlib.util
import io
import re
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
LAYERS = {"jaxfilters": 0, "models": 1, "trackers": 2, "benchmarks": 3}
"""Folders, lowest first; each may import itself and what is below."""
SOURCES = sorted(path for folder in LAYERS for path in (ROOT / folder).rglob("*.py"))
LIBRARY = [path for path in SOURCES if path.relative_to(ROOT).parts[0] in ("jaxfilters", "models")]
TESTS = sorted((ROOT / "tests").rglob("*.py"))
STUBS = sorted((ROOT / "jaxfilters").rglob("*.pyi"))

MODULE_NAMES = {"opencv-python-headless": "cv2", "lazy-loader": "lazy_loader"}
"""Where a distribution is not imported by its own name."""
BEFORE_THE_KEY = {"self", "cls", "filter", "params", "model", "tracker"}
"""What a function belongs to may stand before the random key; nothing else."""
APPLICATION = {"app", "batch", "calibration", "fitting", "gestures"}
"""Folders of `trackers/` that are commands; in the others, only the files below know that there is a command line."""
PRESENTATION = {"command", "options", "run", "drawing", "pictures", "summary", "table", "files", "outcome"}
LONGEST_FILE, LONGEST_FUNCTION = 400, 60
CHANGES_SETTINGS = ("jax.random.key(", "jax.random.PRNGKey(", "random.key(", "PRNGKey(", "jax.config.update(", "print(")
PRIVATE_WORDS = re.compile(
    r"\b(?:seen|learnt|told|somebody|strangers?|afresh|wild|looseness)\b|the specification|\[P\d+\]", re.IGNORECASE
)
"""The field says observed, estimated, reported, person, unknown, anew, outlying, model variance; papers are cited so
that a reader can find them."""
PRIVATE_NAMES = {
    *("Followed", "Job", "Moment", "Past", "Place", "Told", "Way", "Ways"),
    *("admitted", "after_meetings", "left_behind", "looseness", "refusing", "seen_from", "stranger", "told", "who"),
}
"""Of variables, arguments, attributes, functions and classes, where the field has another word."""
Function = ast.FunctionDef | ast.AsyncFunctionDef


@functools.cache
def parsed(path):
    return ast.parse(path.read_text())


def functions(tree):
    return [node for node in ast.walk(tree) if isinstance(node, Function)]


def offenders(paths, rule):
    """One line a finding of `rule(path)`, with the file that it is in."""
    return "\n".join(f"{path.relative_to(ROOT)}: {found}" for path in paths for found in rule(path))


# What the functions and files of the library look like.


def misplaced_keys(path):
    """Public functions whose random key is not first, or has a default."""
    wrong = []
    for function in functions(parsed(path)):
        arguments = [argument.arg for argument in (*function.args.posonlyargs, *function.args.args)]
        names = {*arguments, *(argument.arg for argument in function.args.kwonlyargs)}
        if function.name.startswith("_") or "key" not in names:
            continue
        first = "key" in arguments and set(arguments[: arguments.index("key")]) <= BEFORE_THE_KEY
        has_default = first and len(arguments) - arguments.index("key") <= len(function.args.defaults)
        if not first or has_default:
            wrong.append(function.name)
    return wrong


def calls_that_change_settings(path):
    calls = [ast.unparse(node) for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
    return [call for call in calls if call.startswith(CHANGES_SETTINGS)]


def postponed_annotations(path):
    """With postponed annotations the shape checks of jaxtyping would see strings."""
    return re.findall("from __future__ import annotations", path.read_text())


def without_docstring(path):
    if path.name == "__main__.py":
        return []
    tree = parsed(path)
    public = [n for n in tree.body if isinstance(n, Function | ast.ClassDef) and not n.name.startswith("_")]
    missing = [node.name for node in public if not ast.get_docstring(node)]
    return missing if ast.get_docstring(tree) else [*missing, "the module"]


def docstring_lines(function):
    """Lines of the docstring of a function; those of builders hold arguments, errors and an example."""
    first = function.body[0]
    return first.end_lineno - first.lineno + 1 if ast.get_docstring(function) else 0


def too_long(path):
    lines = len(path.read_text().splitlines())
    long = [f"{lines} lines"] if lines > LONGEST_FILE else []
    sizes = {f.name: f.end_lineno - f.lineno + 1 - docstring_lines(f) for f in functions(parsed(path))}
    return long + [f"{name}: {lines} lines" for name, lines in sizes.items() if lines > LONGEST_FUNCTION]


def private_words(path):
    """Words of comments, docstrings and messages that have another meaning in the field, or none."""
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
    texts = [(token.start[0], token.string) for token in tokens if token.type == tokenize.COMMENT]
    strings = [
        node for node in ast.walk(parsed(path)) if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    texts += [(node.lineno, node.value) for node in strings]
    return [
        f"line {line + text[: match.start()].count(chr(10))}: {match[0]}"
        for line, text in sorted(texts)
        for match in PRIVATE_WORDS.finditer(text)
    ]


def private_names(path):
    """Names of `PRIVATE_NAMES`, with or without a leading underscore."""
    by_kind = {ast.Name: "id", ast.arg: "arg", ast.Attribute: "attr", ast.FunctionDef: "name", ast.ClassDef: "name"}
    nodes = [node for node in ast.walk(parsed(path)) if type(node) in by_kind]
    names = [(node.lineno, getattr(node, by_kind[type(node)])) for node in nodes]
    return [f"line {line}: {name}" for line, name in sorted(names) if name.lstrip("_") in PRIVATE_NAMES]


def test_a_random_key_comes_first_and_has_no_default():
    assert not (found := offenders(SOURCES, misplaced_keys)), found


def test_the_library_makes_no_random_key_and_changes_no_setting():
    assert not (found := offenders(LIBRARY, calls_that_change_settings)), found


def test_annotations_are_evaluated():
    assert not (found := offenders(SOURCES, postponed_annotations)), found


def test_public_names_have_a_docstring():
    assert not (found := offenders(SOURCES, without_docstring)), found


def test_words_are_those_of_the_field():
    assert not (found := offenders(SOURCES, private_words)), found
    assert not (found := offenders(SOURCES, private_names)), found


def test_files_and_functions_can_be_read():
    assert not (found := offenders(SOURCES, too_long)), found
    assert not [path for path in SOURCES if path.stem in {"utils", "helpers", "common", "misc"}]


# What is imported: trackers -> models -> the core, never back.


@functools.cache
def imported(path):
    """The dotted names that a file imports anywhere in it; relative imports keep their leading dots."""
    names = []
    for node in ast.walk(parsed(path)):
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


@functools.cache
def dependencies(*extras):
    """Import names of the declared requirements, with those of the extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [project["dependencies"], *(project["optional-dependencies"][extra] for extra in extras)]
    distributions = [re.split(r"[^\w-]", requirement)[0] for group in groups for requirement in group]
    return {MODULE_NAMES.get(name, name) for name in distributions}


def upward_imports(path):
    here = LAYERS[path.relative_to(ROOT).parts[0]]
    return [name for name in imported(path) if (layer(name) or 0) > here]


def imports_of_the_application(path):
    return [name for name in imported(path) if name.startswith("jaxfilters.trackers.app")]


def imports_of_argparse(path):
    return [name for name in imported(path) if name.split(".")[0] == "argparse"]


def imports_by_another_name(path):
    """`import models.camera` in a checkout would load a second copy of the module, with other classes."""
    return [name for name in imported(path) if name.split(".")[0] in {"", "models", "trackers", "benchmarks"}]


def undeclared_imports(path):
    """The library runs without extras; only benchmarks may use theirs."""
    extras = ("bench",) if path.relative_to(ROOT).parts[0] == "benchmarks" else ()
    known = dependencies(*extras) | set(sys.stdlib_module_names) | {"jaxfilters"}
    return {name.split(".")[0] for name in imported(path)} - known


def early_imports_of_jaxopt(path):
    """Its import warns; who does not use it should not have to read that."""
    at_the_top = [ast.unparse(n) for n in parsed(path).body if isinstance(n, ast.Import | ast.ImportFrom)]
    return [line for line in at_the_top if "jaxopt" in line]


def test_imports_run_downwards():
    assert not (found := offenders(SOURCES, upward_imports)), found


def test_trackers_import_nothing_of_the_application_around_them():
    systems = [path for path in (ROOT / "trackers").rglob("*.py") if not APPLICATION & set(path.parts)]
    paths = sorted(path for path in systems if path.stem not in PRESENTATION)
    assert not (found := offenders(paths, imports_of_the_application)), found


def test_command_lines_are_known_to_commands_and_the_application_alone():
    systems = [path for path in (ROOT / "trackers").rglob("*.py") if not APPLICATION & set(path.parts)]
    paths = sorted(path for path in systems if path.stem not in {"command", "options"})
    assert not (found := offenders(paths, imports_of_argparse)), found


def test_our_modules_have_one_name():
    assert not (found := offenders(SOURCES + TESTS, imports_by_another_name)), found


def test_every_import_is_declared():
    assert not (found := offenders(SOURCES, undeclared_imports)), found


def test_jaxopt_is_imported_where_it_is_used():
    assert not (found := offenders(SOURCES, early_imports_of_jaxopt)), found


# What the package says that it holds.


def listed(stub):
    """The public names of a stub: what it imports under its own name."""
    nodes = [node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)]
    return [alias.asname for node in nodes for alias in node.names if alias.asname]


def package_of(stub):
    return importlib.import_module(".".join(stub.parent.relative_to(ROOT).parts))


def test_public_names_are_those_of_the_stub_and_can_be_loaded():
    assert STUBS
    for stub in STUBS:
        package = package_of(stub)
        assert sorted(package.__all__) == sorted(listed(stub)), package.__name__
        assert set(package.__all__) <= set(dir(package)), package.__name__
        missing = [name for name in package.__all__ if not hasattr(package, name)]
        assert not missing, f"{package.__name__}: {missing}"


def test_no_public_function_hides_a_module_of_its_name():
    packages = [path.parent.relative_to(ROOT) for path in (ROOT / "jaxfilters").rglob("__init__.py")]
    assert len(packages) > 8
    for path in packages:
        package = importlib.import_module(".".join(path.parts))
        modules = {found.stem for found in (ROOT / path).iterdir() if found.suffix in (".py", "")}
        callables = {name for name in dir(package) if callable(getattr(package, name)) and not name.startswith("_")}
        assert not callables & modules, path


# What tests look like.


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


def hidden(path):
    names = Counter(node.name for node in parsed(path).body if isinstance(node, Function | ast.ClassDef))
    return [name for name, count in names.items() if count > 1]


def with_uncollected_tests(path):
    """Tests in a file that pytest does not collect."""
    return [f.name for f in functions(parsed(path)) if f.name.startswith("test_") and path.name[:5] != "test_"]


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


def test_every_function_of_the_tests_is_collected_or_used():
    files = [path for path in TESTS if path.name.startswith("test_")]
    assert not (found := offenders(files, uncollected)), found


def test_no_test_hides_another_of_the_same_name():
    assert not (found := offenders(TESTS, hidden)), found


def test_files_with_tests_are_collected():
    assert not (found := offenders(TESTS, with_uncollected_tests)), found


def test_every_test_can_fail():
    assert not (found := offenders(TESTS, unfailing)), found


# The rules notice what they forbid.


def written(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


def test_the_rules_for_functions_and_files_notice_what_they_forbid(tmp_path):
    keys = "def f(x, key): ...\ndef g(key=None): ...\ndef h(*, key): ...\ndef ok(params, key, x=1): ..."
    assert misplaced_keys(written(tmp_path, "keys.py", keys)) == ["f", "g", "h"]
    settings = "a = jax.random.key(0)\nb = split(key)\nprint(b)"
    assert calls_that_change_settings(written(tmp_path, "settings.py", settings)) == ["jax.random.key(0)", "print(b)"]
    future = "from __future__ import annotations"
    assert postponed_annotations(written(tmp_path, "future.py", future)) == [future]
    undocumented = 'def f(): ...\ndef _g(): ...\nclass C:\n    """C."""'
    assert without_docstring(written(tmp_path, "undocumented.py", undocumented)) == ["f", "the module"]
    long = "def f():\n" + LONGEST_FILE * "    x = 1\n"
    assert too_long(written(tmp_path, "long.py", long)) == ["401 lines", "f: 401 lines"]
    words = '"""A docstring.\n\nAs the specification says [P14]."""\nseen = 1  # told\nf"{seen} wildly Learnt {seen}"'
    found = private_words(written(tmp_path, "words.py", words))
    assert found == ["line 3: the specification", "line 3: [P14]", "line 4: told", "line 5: Learnt"]
    names = "class _Way:\n    def refusing(self, who):\n        self.told = seen_from\n        return whose"
    found = private_names(written(tmp_path, "names.py", names))
    assert found == ["line 1: _Way", "line 2: refusing", "line 2: who", "line 3: seen_from", "line 3: told"]


def test_the_rules_for_imports_notice_what_they_forbid(tmp_path, monkeypatch):
    text = (
        "import os.path, jaxfilters.models\nfrom . import b\nfrom jaxfilters import trackers\nimport jaxopt\n"
        "def f():\n    from jaxfilters.models.camera import Pinhole\n    from jaxfilters.trackers.app import cli\n"
    )
    (tmp_path / "models").mkdir()
    path = written(tmp_path / "models", "a.py", text)
    names = ["os.path", "jaxfilters.models", "..b", "jaxfilters.trackers", "jaxopt"]
    inner = ["jaxfilters.models.camera.Pinhole", "jaxfilters.trackers.app.cli"]
    assert sorted(imported(path)) == sorted(names + inner)
    assert [layer(name) for name in (*names, *inner)] == [None, 1, None, 2, None, 1, 2]
    assert dependencies() >= {"jax", "jaxopt", "cv2"}
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    assert sorted(upward_imports(path)) == ["jaxfilters.trackers", "jaxfilters.trackers.app.cli"]
    assert imports_of_the_application(path) == ["jaxfilters.trackers.app.cli"]
    assert imports_by_another_name(path) == ["..b"]
    assert undeclared_imports(path) == {""}
    assert early_imports_of_jaxopt(path) == ["import jaxopt"]


def test_the_rules_for_tests_notice_what_they_forbid(tmp_path):
    path = written(tmp_path, "test_a.py", "def tset_typo(): assert f()\ndef f(): ...\ndef test_it(): ...\ndef f(): ...")
    assert uncollected(path) == ["tset_typo"]
    assert hidden(path) == ["f"]
    assert unfailing(path) == ["test_it"]
    assert with_uncollected_tests(written(tmp_path, "checks.py", "def test_it(): assert True")) == ["test_it"]


def test_the_reader_of_stubs_lists_public_names_only(tmp_path):
    stub = written(tmp_path, "__init__.pyi", "from . import a as a\nfrom .b import c as c\nfrom .d import e\nx: int")
    assert listed(stub) == ["a", "c"]
