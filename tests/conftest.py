import gc
import os
from pathlib import Path

import jax
import pytest

MANY_MAPPINGS = 40_000
"""Linux ends a process that maps 65530 regions (`vm.max_map_count`); every compiled program holds several, and no file
of tests adds more than 3000."""

# Tracing makes millions of small objects that live on: looking through all of them for garbage, again and again, is
# a tenth of a run.
gc.freeze()
gc.set_threshold(100_000, 20, 100)

QUICK = "jax_disable_most_optimizations"
"""JAX's own option; where its variable in the environment is set, that decides for all tests."""


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


@pytest.fixture(scope="session")
def root():
    """The checkout that holds these tests."""
    return Path(__file__).parents[1]
