import importlib

scenario = importlib.import_module("jaxfilters.benchmarks.scenarios.import")


def test_differences_are_those_of_pairs(monkeypatch):
    # The library takes 3 s more than JAX in every round, while rounds differ by much more.
    seconds = {"import jax": [0.0, 10.0, 50.0, 20.0], "import jax, jaxfilters": [0.0, 13.0, 53.0, 23.0]}
    monkeypatch.setattr(scenario, "_seconds", lambda program: seconds[program].pop(0))
    found = {name: metric.value for name, metric in scenario.run(quick=True, seed=0, out=None).items()}
    assert found == {"import_jax_s": 20, "import_jaxfilters_s": 23, "import_beyond_jax_s": 3}
