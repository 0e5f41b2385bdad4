import json
import re
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.results_page import ON_RECORDINGS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def block(language, after=""):
    """The first code block of a language after some text."""
    return re.search(rf"```{language}\n(.*?)```", README[README.index(after) :], re.DOTALL)[1]


def test_the_example_runs_and_finds_the_point():
    example = {}
    exec(block("python", after="<!-- example -->"), example)
    dts = jnp.asarray(np.random.default_rng(0).uniform(0.05, 0.2, 150), jnp.float32)
    angles = 0.5 * jnp.cumsum(dts)
    truth = jnp.stack([5 + 3 * jnp.cos(angles), 5 + 3 * jnp.sin(angles)], axis=-1)
    distances = jnp.linalg.norm(truth[:, None] - example["BEACONS"], axis=-1)
    noisy = distances + 0.1 * jax.random.normal(jax.random.key(1), distances.shape)
    means, log_evidence = example["track"](jax.random.key(2), noisy, dts)
    # Least squares over the three distances of one moment, of standard deviation 0.1 each, has the error `single`;
    # a filter that also uses earlier distances stays below it.
    directions = (truth[:, None] - example["BEACONS"]) / distances[..., None]
    single = 0.1 * jnp.sqrt(jnp.trace(jnp.linalg.inv(jnp.einsum("tbi,tbj->tij", directions, directions)), 0, 1, 2))
    error = jnp.linalg.norm(means[:, :2] - truth, axis=-1)
    assert jnp.sqrt(jnp.mean(error[30:] ** 2)) < jnp.sqrt(jnp.mean(single[30:] ** 2))
    assert jnp.isfinite(log_evidence)


def test_the_example_is_short():
    lines = block("python", after="<!-- example -->").splitlines()
    assert len([line for line in lines if line.strip() and not line.startswith(("import", "from"))]) <= 20


def test_the_page_opens_with_the_demo_and_the_tests():
    commands = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    assert commands[0].startswith("python3 -m venv")
    assert commands[0].strip().endswith("jaxfilters demo")
    assert commands[1].startswith("python3 -m venv")
    assert commands[1].strip().endswith("-m pytest -n 2")
    assert all(command.count("\n") == 1 for command in commands[:2])


def test_links_and_pictures_lead_somewhere():
    found = re.findall(r"\]\(([^)]+)\)", README) + re.findall(r'<img src="([^"]+)"', README)
    targets = [target.partition("#")[0] for target in found if not target.startswith("http")]
    assert targets
    assert not [target for target in targets if not (ROOT / target).exists()]


def test_the_page_is_short():
    assert len(README.splitlines()) <= 160


def rows_of(page):
    return re.findall(r"\| ([\d.]+) \| `(\w+)` \|$", (ROOT / page).read_text(), re.MULTILINE)


def test_measured_results_are_those_of_the_page_of_results():
    measured = json.loads((ROOT / "docs" / "results" / "filters.json").read_text())["metrics"]
    rows = rows_of("README.md")
    assert len(rows) > 5
    assert {name: float(value) for value, name in rows} == {
        name: float(f"{measured[name]['value']:.2g}") for _, name in rows
    }


def test_accuracy_on_recordings_is_that_of_the_page_of_results():
    rows = re.findall(r"\| (\S+ \S+) \| (\S+ \S+) \| `([\w-]+)`: `(\w+)` \|$", README, re.MULTILINE)
    assert len(rows) > 5
    for value, value_of_simplest, scenario, name in rows:
        measured = json.loads((ROOT / "docs" / "results" / f"{scenario}.json").read_text())["metrics"]
        on_page = [(row.metric, row.metric_of_simplest) for row in ON_RECORDINGS]
        found = [[measured[key] for key in keys] for keys in on_page if keys[0] == name and set(keys) <= set(measured)]
        assert [value, value_of_simplest] in [[f"{x['value']:.3g} {x['unit']}" for x in pair] for pair in found]


def test_values_of_the_page_of_benchmarks_are_those_of_the_baseline():
    baseline = json.loads((ROOT / "benchmarks" / "baseline.json").read_text())["filters"]
    rows = rows_of("docs/benchmarks.md")
    assert len(rows) > 5
    assert {name: float(value) for value, name in rows} == {name: baseline[name]["value"] for _, name in rows}


def test_every_folder_has_its_row():
    folders = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-dir"]
    for name, folder in folders.items():
        assert f"| `{folder}/` | `{name}` |" in README
