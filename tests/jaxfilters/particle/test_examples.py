"""The examples in the docstrings of particle and ensemble filters run and print what they say."""

import doctest
from importlib import import_module

import pytest

MODULES = [
    "jaxfilters.gaussian.ensemble",
    "jaxfilters.noise",
    "jaxfilters.particle.adaptive",
    "jaxfilters.particle.bootstrap",
    "jaxfilters.particle.guided",
    "jaxfilters.particle.partitioned",
    "jaxfilters.particle.rao_blackwell",
    "jaxfilters.particle.resampling",
    "jaxfilters.particle.sharding",
    "jaxfilters.particle.smoothing",
    "jaxfilters.particle.tempering",
    "jaxfilters.priors",
    "jaxfilters.weights",
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    failed, attempted = doctest.testmod(import_module(name))
    assert attempted > 0
    assert failed == 0
