"""Settings of every test run, the border between quick and system tests, and fixtures for all of them."""

import gc
import os
import resource
import sys
import time
from importlib.metadata import version
from pathlib import Path

import pytest

# JAX reads these variables when it is imported, and worker processes inherit them from the process that starts them.
# Most of the time of a test is compilation. XLA's newer emitters take twice as long for the same programs, and pieces
# of a program compiled in parallel take a fifth longer where no core is idle. Threads of OpenBLAS spin while they wait,
# on the core of the other worker.
assert "jax" not in sys.modules, "JAX was imported before tests/conftest.py could set how its programs are compiled."
# From 0.11 on there is no older emitter, and XLA ends a process that names a flag which it does not know.
OLDER_EMITTERS = "--xla_cpu_use_fusion_emitters=false " if version("jaxlib").startswith("0.10.") else ""
os.environ.setdefault("XLA_FLAGS", f"{OLDER_EMITTERS}--xla_cpu_parallel_codegen_split_count=1")
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

PROCESSOR_SECONDS = pytest.StashKey[float]()
"""Processor time of the set-up and the call of a test."""

MANY_MAPPINGS = 40_000
"""Linux ends a process that maps 65530 regions (`vm.max_map_count`); every compiled program holds several, and no file
of tests adds more than 3000."""

# Tracing makes millions of small objects that live on: looking through all of them for garbage, again and again, is
# a tenth of a run.
gc.freeze()
gc.set_threshold(100_000, 20, 100)

QUICK = "jax_disable_most_optimizations"
"""JAX's own option; where its variable in the environment is set, that decides for all tests."""


def pytest_addoption(parser):
    help = "fail a test that is not marked `system` and takes more than this many seconds of processor time"
    parser.addoption("--processor-limit", type=float, metavar="SECONDS", help=help)


def processor_s():
    """Processor time of this process, all its threads, and the processes that it started and waited for, in seconds."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item, call):
    """Holds the border of `system`: processor time, because wall time depends on what else the machine does.

    A fixture that several tests share counts for the first of them.
    """
    report = yield
    now = processor_s()
    if call.when == "call":
        taken, limit = now - item.stash[PROCESSOR_SECONDS], item.config.getoption("processor_limit")
        report.user_properties.append(("processor_s", round(taken, 3)))
        if limit is not None and taken > limit and report.passed and item.get_closest_marker("system") is None:
            report.outcome = "failed"
            report.longrepr = (
                f"{item.nodeid} took {taken:.1f} s of processor time: mark it `system`, or make it smaller."
            )
    return report


def pytest_terminal_summary(terminalreporter):
    """Lists the tests that took most of the processor, where `--durations` asks for the slowest."""
    count = terminalreporter.config.getoption("durations")
    if not count:
        return
    reports = [report for group in ("passed", "failed") for report in terminalreporter.stats.get(group, [])]
    taken = {report.nodeid: dict(report.user_properties).get("processor_s", 0.0) for report in reports}
    terminalreporter.section(f"processor time, {sum(taken.values()):.0f} s in all")
    for name in sorted(taken, key=taken.get, reverse=True)[:count]:
        terminalreporter.write_line(f"{taken[name]:8.2f} s {name}")


def pytest_collection_modifyitems(items):
    """Puts a test of every system or page, by its parameter, behind the tests of that system: they share programs."""
    from jaxfilters.trackers.registry import SYSTEMS  # checked by jaxtyping if imported this late

    folders = {system.name: system.package.removeprefix("jaxfilters.").replace(".", "/") for system in SYSTEMS}

    def place(item):
        path = str(item.path.relative_to(item.config.rootpath))
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        names = [str(value).removesuffix(".md") for value in parameters if isinstance(value, str | Path)]
        of_system = [folders.get(name) or name.rpartition("/docs/")[2] for name in names]
        return next((f"tests/{folder}~" for folder in of_system if folder.startswith("trackers/")), path)

    items.sort(key=place)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    item.stash[PROCESSOR_SECONDS] = processor_s()
    return (yield)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Compiles in a third of the time, without most optimisations, but where a test runs for longer than it compiles.

    A hook, not a fixture: what the fixtures of a module compile is for the test that asks for them first.
    """
    if QUICK.upper() not in os.environ:
        jax.config.update(QUICK, item.get_closest_marker("optimised") is None)


@pytest.fixture(autouse=True, scope="session")
def _videos_of_faces_are_rendered_quickly():
    """The programs that render them are few and run in hundreds of frames: always with all optimisations."""
    from jaxfilters.models.synthetic import face_sequence, ict_sequence  # checked by jaxtyping if imported this late

    def rendered(*arguments):
        before = jax.config.values[QUICK]
        jax.config.update(QUICK, False)
        try:
            return original(*arguments)
        finally:
            jax.config.update(QUICK, before)

    original = face_sequence.rendered
    with pytest.MonkeyPatch.context() as patch:
        for module in (face_sequence, ict_sequence):
            patch.setattr(module, "rendered", rendered)
        yield


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_programs():
    """Drops the programs of earlier files once they are many: a worker that runs half of the suite would crash."""
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > MANY_MAPPINGS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def x64():
    """64-bit floats for one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def data_dir():
    """The folder of recordings that nobody may redistribute; tests that need it are skipped without it."""
    folder = os.environ.get("JAXFILTERS_DATA")
    if not folder:
        pytest.skip("JAXFILTERS_DATA is not set: no recordings to read")
    return Path(folder)


def _programs_in(value):
    """The programs inside of a parameter of an operation: bodies of loops, branches, compiled functions."""
    if hasattr(value, "eqns") or hasattr(value, "jaxpr"):
        yield getattr(value, "jaxpr", value)
    elif isinstance(value, tuple | list):
        for item in value:
            yield from _programs_in(item)


@pytest.fixture(scope="session")
def products_at_default_precision():
    """`f(function, *args, own=True)`: the lines whose products of floats leave their precision to the device.

    Only lines of the package, unless `own` is False: the models of tests are the tests' own. A product inside of one of
    JAX's functions counts for the line that calls it, and a derivative for the product that it is of.
    """

    from jaxfilters import models, trackers  # checked by jaxtyping if imported this late

    tests = str(Path(__file__).parent) + os.sep
    folders = (tests, *(package.__path__[0] + os.sep for package in (sys.modules["jaxfilters"], models, trackers)))

    def line_of(eqn, caller):
        frames = eqn.source_info.traceback.frames if eqn.source_info.traceback else ()
        here = (f"{frame.file_name}:{frame.line_num}" for frame in frames if frame.file_name.startswith(folders))
        return next(here, caller)

    def products(program, caller):
        for eqn in program.eqns:
            line = line_of(eqn, caller)
            if eqn.primitive.name in ("dot_general", "conv_general_dilated") and eqn.params["precision"] is None:
                yield from [line] * jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.inexact)
            for inner in _programs_in(tuple(eqn.params.values())):
                yield from products(inner, line)

    def found(function, *args, own=True):
        # A library that another test imported may have set it for the whole process.
        with jax.default_matmul_precision(None):
            lines = dict.fromkeys(products(jax.make_jaxpr(function)(*args).jaxpr, ""))
        return [line for line in lines if not own or not line.startswith(tests)]

    return found


@pytest.fixture(scope="session")
def root():
    """The checkout that holds these tests."""
    return Path(__file__).parents[1]
