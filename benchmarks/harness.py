"""`jaxfilters bench SCENARIO`, also `python -m jaxfilters.benchmarks SCENARIO`.

A scenario is a module in `scenarios/` with `run(*, quick, seed, out) -> dict[str, Metric]`; its docstring says what it
measures, and its file name, with dashes, is its name. One that compares with a file of truth takes `truth`, too.
With `--gate` the exit code says whether anything is worse than a baseline allows.
"""

import argparse
import ast
import importlib
import inspect
import json
import pkgutil
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from jaxfilters.benchmarks import gate, metrics, scenarios
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.results_page import read_results, results_page
from jaxfilters.trackers.app.devices import use_all_cores
from jaxfilters.trackers.io.errors import InputError

REGRESSION, FAILURE = 1, 2
"""Exit codes: worse than the baseline allows; wrong arguments, missing packages and files that cannot be written."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one scenario, print its table, write its JSON."""
    use_all_cores()
    found = descriptions()
    parser = _parser(found)
    options = parser.parse_args(argv)
    if (options.scenario is None) == (options.report is None):
        parser.error("expected either a SCENARIO or --report")
    if options.report is not None:
        return _report(options.report, found)
    if options.json and not options.json.parent.is_dir():
        return _fail(f"--json: no folder {options.json.parent}")
    try:
        if options.out:
            options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return _fail(f"--out: no folder {options.out} can be made ({error.strerror})")
    try:
        bounds = gate.load(options.baseline, options.scenario) if options.gate else {}
    except ValueError as error:
        return _fail(f"--gate: {error}")
    try:
        scenario = importlib.import_module(f"{scenarios.__name__}.{options.scenario.replace('-', '_')}")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("jaxfilters"):
            raise
        return _fail(f"{options.scenario} needs {error.name}: pip install 'jaxfilters[bench]'")
    more = {"truth": options.truth} if options.truth else {}
    if more and "truth" not in inspect.signature(scenario.run).parameters:
        return _fail(f"--truth: {options.scenario} compares with no file")
    try:
        measured = scenario.run(quick=options.quick, seed=options.seed, out=options.out, **more)
    except (RecordingError, InputError) as error:
        return _fail(f"{options.scenario}: {error}")
    print(metrics.table(measured))
    if options.json:
        from jaxfilters.benchmarks.environment import environment

        today = datetime.now(UTC).date().isoformat()
        document = metrics.report(options.scenario, measured, environment() | {"date": today})
        options.json.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")
    return _gate(bounds, measured) if options.gate else 0


def descriptions() -> dict[str, str]:
    """Names of the scenarios and the first lines of their docstrings, read without importing them."""
    found = {}
    for folder in scenarios.__path__:
        for module in pkgutil.iter_modules([folder]):
            if not module.name.startswith("_"):
                source = (Path(folder) / f"{module.name}.py").read_text(encoding="utf-8")
                docstring = ast.get_docstring(ast.parse(source)) or ""
                found[module.name.replace("_", "-")] = docstring.partition("\n")[0]
    return dict(sorted(found.items()))


def _report(paths: Sequence[Path], found: Mapping[str, str]) -> int:
    try:
        print(results_page(read_results(paths), found), end="")
    except ValueError as error:
        return _fail(f"--report: {error}")
    return 0


def _gate(bounds: Mapping[str, gate.Bound], measured: Mapping[str, metrics.Metric]) -> int:
    rows = gate.compare(bounds, measured)
    print(f"\n{gate.table(rows)}")
    return 0 if gate.passes(rows) else REGRESSION


def _parser(found: dict[str, str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxfilters bench",
        description="Measure speed and accuracy.",
        epilog="scenarios:\n" + "\n".join(f"  {name:16} {line}" for name, line in found.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scenario", nargs="?", choices=found, metavar="SCENARIO", help="what to measure, see below")
    parser.add_argument(
        "--report",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="measure nothing; print a page of results in Markdown from files that --json wrote, or folders of them",
    )
    parser.add_argument("--quick", action="store_true", help="fewer seeds and rounds: to see that it runs")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="first random seed (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers and the environment there")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="what to compare with, where it is a file's to say")
    parser.add_argument(
        "--gate", action="store_true", help="compare with the baseline; exit 1 where something is worse"
    )
    parser.add_argument(
        "--baseline",
        type=Path,
        metavar="FILE",
        default=gate.BASELINE,
        help="what to compare with (default: the committed one)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="write plots there, and what is finished")
    return parser


def _fail(message: str) -> int:
    print(f"jaxfilters bench: error: {message}", file=sys.stderr)
    return FAILURE
