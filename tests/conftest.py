import os
from pathlib import Path

import jax
import pytest


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
