"""The pages in docs/ run as they stand, block after block; their links and commands hold."""

import argparse
import importlib
import re
import shlex
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import jaxfilters
from jaxfilters.benchmarks.harness import descriptions
from jaxfilters.benchmarks.results_page import read_results, results_page
from jaxfilters.models.synthetic.hand import MOTIONS
from jaxfilters.trackers.app import cli

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
COMING_FROM = sorted((DOCS / "coming_from").glob("*.md"))
MANUALS = {
    "track hand-depth": "trackers/hand_depth.md",
    "track articulated": "trackers/articulated.md",
    "track people": "trackers/people.md",
    "track head-stereo": "trackers/head.md",
    "track head-mono": "trackers/head.md",
    "track fingertips": "trackers/fingertips.md",
    "calibrate points": "trackers/people.md",
    "calibrate charuco": "trackers/people.md",
    "calibrate tsai": "trackers/people.md",
    "calibrate stereo": "trackers/head.md",
    "fit face-detector": "trackers/head.md",
    "fit face-model": "trackers/head.md",
    "fit gestures": "trackers/fingertips.md",
    "fit noise": "trackers/fingertips.md",
    "recognise": "trackers/fingertips.md",
    "view": "viewer.md",
    "batch": "batch.md",
}
"""Where the manual of each command is."""

NEEDED_BY_PAGES = {"blackjax": "mcmc", "numpyro": "mcmc", "matplotlib": "viz"}
"""Libraries with their extras; what a page says after importing one that is missing is skipped."""


def name_of(page):
    return str(page.relative_to(DOCS).with_suffix(""))


def links(page):
    """The relative links of a page as (path, fragment)."""
    without_code = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    targets = [target for target in re.findall(r"\]\(([^)\s]+)\)", without_code) if not target.startswith("http")]
    return [((page.parent / path).resolve() if path else page, fragment) for path, _, fragment in split(targets)]


def split(targets):
    return [target.partition("#") for target in targets]


def anchors(page):
    """What the headings of a page are called in links to them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def subcommands(parser, words=()):
    """(words, parser) of every command that has no commands of its own."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not inner:
        return [(" ".join(words), parser)]
    return [leaf for name, child in inner[0].choices.items() for leaf in subcommands(child, (*words, name))]


def exists(name):
    """Whether a dotted name that begins with `jf` or `jaxfilters` is an attribute or a module."""
    path, found = "jaxfilters", jaxfilters
    for part in name.split(".")[1:]:
        path = f"{path}.{part}"
        try:
            found = getattr(found, part)
        except AttributeError:
            try:
                found = importlib.import_module(path)
            except ModuleNotFoundError:
                return False
    return True


def code_of(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


def sides_of(page):
    """(library, code) of every block of Python on a page; library is empty where it is this one."""
    return re.findall(r"```python ?(\w*)\n(.*?)```", page.read_text(), re.DOTALL)


@pytest.mark.system
@pytest.mark.parametrize("page", [page for page in PAGES if code_of(page)], ids=name_of)
def test_the_code_of_a_page_runs(page, monkeypatch):
    """The synthetic hand of 150 frames, of which a page follows eight, is rendered for those."""
    monkeypatch.setitem(MOTIONS, "B", MOTIONS["B"]._replace(num_frames=8))
    if page in COMING_FROM and find_spec(page.stem) is not None:
        pytest.skip(f"{page.stem} is installed: the test of both libraries runs all of the page")
    names = {"__name__": page.stem}
    for block in code_of(page):
        for library in NEEDED_BY_PAGES.keys() & set(re.findall(r"^import (\w+)", block, re.MULTILINE)):
            pytest.importorskip(library, reason=f"the rest of {page.name} needs the extra {NEEDED_BY_PAGES[library]}")
        exec(compile(block, str(page), "exec"), names)
    assert len(names) > 2


ERRORS = {
    "cuthbert": {"particle_filter.build_filter": 0.5},
    "particles": {"logLt": 0.3, "theirs = np": 0.3},
    "filterpy": {"bincount": 0.05},
    "blackjax": {"getattr": 0.02, "draws": 0.25},
}
"""Largest absolute differences of what is random: about five standard errors of what a block with these words has."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.system
@pytest.mark.parametrize("page", COMING_FROM, ids=name_of)
def test_the_code_of_both_libraries_finds_the_same(page):
    """Where the other library is installed; the page before runs ours in any case."""
    peer = page.stem
    pytest.importorskip(peer)
    names, theirs, compared = {"__name__": peer}, None, 0
    np.random.seed(0)  # noqa: NPY002 (particles draws from this generator)
    for library, code in sides_of(page):
        names.pop("theirs", None), names.pop("ours", None)
        exec(compile(code, str(page), "exec"), names)
        if library:
            assert library == peer
            theirs = (names["theirs"], code) if "theirs" in names else None
        elif "ours" in names and theirs is not None:
            expected, of = theirs
            atol = max((error for words, error in ERRORS.get(peer, {}).items() if words in of), default=2e-3)
            check_same(names["ours"], expected, atol)
            theirs, compared = None, compared + 1
    assert compared >= 4


def check_same(ours, theirs, atol):
    ours, theirs = ((one if isinstance(one, tuple) else (one,)) for one in (ours, theirs))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(np.squeeze(a), np.squeeze(b), rtol=2e-3, atol=atol)


def test_links_lead_somewhere():
    broken = [
        f"{name_of(page)}: {path}#{fragment}"
        for page in PAGES
        for path, fragment in links(page)
        if not path.exists() or (fragment and fragment not in anchors(path))
    ]
    assert not broken


def test_every_page_can_be_reached_from_the_index():
    reached, waiting = set(), [DOCS / "index.md"]
    while waiting:
        page = waiting.pop()
        reached.add(page)
        waiting += [path for path, _ in links(page) if path in PAGES and path not in reached]
    assert not set(PAGES) - reached


def test_every_page_is_in_the_navigation_of_the_site():
    listed = re.findall(r"([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    from_the_root = {"changelog.md", "contributing.md"}
    assert set(listed) - from_the_root == {str(page.relative_to(DOCS)) for page in PAGES}


def test_the_reference_has_every_public_name_once():
    pages = "".join(page.read_text() for page in (DOCS / "api").glob("*.md"))
    entries = re.findall(r"^::: (\S+)$", pages, re.MULTILINE)
    assert len(entries) == len(set(entries)) > 200
    assert not [entry for entry in entries if not exists(entry)]
    assert not without_entry(jaxfilters, "jaxfilters", entries)


def without_entry(module, path, entries):
    """Public names of a module that the reference has neither by themselves nor with the module that defines them."""
    missing = []
    for name in module.__all__:
        value, place = getattr(module, name), f"{path}.{name}"
        if isinstance(value, ModuleType):
            if not any(f"{entry}.".startswith((f"{value.__name__}.", f"{place}.")) for entry in entries):
                missing += without_entry(value, place, entries) if hasattr(value, "__all__") else [place]
        elif place not in entries and getattr(value, "__module__", "") not in entries:
            missing.append(place)
    return missing


def test_names_in_pages_exist():
    new_names = re.sub(r"^\| [^|]* \|", "|", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    texts = [page.read_text() for page in [ROOT / "README.md", *PAGES]] + [new_names.partition("#### Running")[2]]
    names = {name for text in texts for name in re.findall(r"`(?:[^`\n]*[ (=])?(jf(?:\.\w+)+)", text)}
    names |= set(re.findall(r"`(jaxfilters(?:\.\w+)+)[`(]", "".join(texts)))
    assert len(names) > 60
    assert not sorted(name for name in names if not exists(name))


def test_every_command_has_a_manual_with_all_its_options_and_choices():
    missing = []
    for words, parser in subcommands(cli._parser()):
        if words in ("demo", "bench"):  # the former has the options of `track hand-depth`, the latter another parser
            continue
        manual = (DOCS / MANUALS[words]).read_text()
        options = [max(action.option_strings, key=len) for action in parser._actions if action.option_strings]
        missing += [f"{words} {option}" for option in options if option != "--help" and f"`{option}" not in manual]
        choices = [str(choice) for action in parser._actions for choice in action.choices or ()]
        missing += [f"{words} {choice}" for choice in choices if not re.search(rf"`[^`]*\b{choice}\b[^`]*`", manual)]
    assert not missing


def test_the_page_of_results_is_made_of_the_files_of_runs():
    made = results_page(read_results([DOCS / "results"]), descriptions())
    assert (DOCS / "results.md").read_text() == made


def test_commands_in_pages_are_understood():
    wrong = []
    for page in [ROOT / "README.md", *PAGES]:
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                command, *arguments = shlex.split(line.rpartition("&& ")[2], comments=True) or [""]
                if not command.endswith("jaxfilters") or arguments[:1] == ["bench"]:
                    continue
                try:
                    cli._parser().parse_args(arguments)
                except SystemExit:
                    wrong.append(f"{page.name}: {line}")
    assert not wrong
