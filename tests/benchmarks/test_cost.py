"""The scenario of cost: constants are found again, every computation has its metrics, processes agree with devices."""

import pytest

from jaxfilters.benchmarks.scenarios import cost
from jaxfilters.benchmarks.scenarios._cost_families import FAMILIES
from jaxfilters.benchmarks.scenarios._cost_worker import Request


def test_constants_of_a_sum_are_found_again_and_none_is_negative():
    terms = {"step": (0, 0), "n": (1, 0), "n_d2": (1, 2)}
    sizes = [(10, 2), (1000, 2), (10, 5), (3000, 7)]
    values = {(n, d): 50.0 + 0.25 * n * d**2 for n, d in sizes}
    found = cost.fit(terms, values)
    assert found == pytest.approx({"step": 50.0, "n": 0.0, "n_d2": 0.25}, rel=1e-6, abs=1e-6)
    assert cost.predicted(terms, found, (10**6, 3)) == pytest.approx(50.0 + 0.25e6 * 9)
    decreasing = cost.fit({"step": (0,), "n": (1,)}, {(1,): 3.0, (2,): 2.0})
    assert decreasing["n"] == 0.0


@pytest.mark.parametrize("name", FAMILIES)
def test_the_sizes_of_a_family_determine_its_constants_and_end_with_an_extrapolation(name):
    family = FAMILIES[name]
    for fitted, held_out in (family.quick, (family.fitted, family.held_out)):
        assert not set(fitted) & set(held_out)
        assert {len(size) for size in (*fitted, *held_out, *family.terms.values())} == {len(fitted[0])}
    assert len(family.fitted) >= len(family.terms)
    inner, beyond = family.held_out
    assert inner[0] < max(size[0] for size in family.fitted) < beyond[0]


@pytest.mark.system
def test_a_family_has_constants_and_errors():
    family = FAMILIES["tracks"]
    found = cost.modelled("tracks", family, family.quick, 0, 1)
    terms = {f"tracks_{unit}_{term}" for unit in ("ns", "bytes") for term in ("step", "b")}
    assert set(found) == terms | {"tracks_time_error_15", "tracks_memory_error_15"}
    assert found["tracks_memory_error_15"].value < 0.01


@pytest.mark.system
def test_two_processes_say_what_two_devices_of_one_say():
    request = Request(1, [64], 1, 0, 2)
    devices, processes = cost.asked(request, 2), cost.asked(request._replace(processes=2), 1)
    assert devices["log_evidence"] == pytest.approx(processes["log_evidence"], rel=1e-5)
    assert devices["mean"] == pytest.approx(processes["mean"], rel=1e-4)
    assert devices["log_evidence"] != cost.asked(request, 1)["log_evidence"]
    assert devices["seconds"]["64"] > 0
