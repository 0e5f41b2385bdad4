"""Every script of the gallery runs by itself, draws its picture and computes the numbers that it states."""

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
SCRIPTS = sorted((DOCS / "examples").glob("*.py"))
LONG = {"bearings_only", "hand_fit", "neural_observation", "stochastic_volatility"}
"""Which run for longer than they compile."""
LARGEST_PICTURE = 80 * 1024


def stated(script):
    """The bold numbers of the result in the first cell."""
    first = script.read_text().split("# %%")[1].replace("\n#", "")
    return [float(number) for number in re.findall(r"\*\*(-?[\d.]+)\*\*", first.partition("**Result:**")[2])]


@pytest.mark.system
@pytest.mark.parametrize(
    "script",
    [pytest.param(path, marks=[pytest.mark.optimised] * (path.stem in LONG), id=path.stem) for path in SCRIPTS],
)
def test_a_script_computes_what_it_states(script, tmp_path, monkeypatch):
    """Random numbers are the same everywhere; 10 percent are left to the rounding of other processors."""
    matplotlib = pytest.importorskip("matplotlib", reason="the pictures need the extra viz")
    matplotlib.use("Agg")
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path)])
    monkeypatch.chdir(tmp_path)
    with matplotlib.rc_context():
        names = runpy.run_path(str(script))
    names["plt"].close("all")
    np.testing.assert_allclose(names["result"], stated(script), rtol=0.1)
    assert (tmp_path / f"{script.stem}.webp").stat().st_size > 5000


def test_the_gallery_lists_every_script_with_its_picture():
    page = (DOCS / "gallery.md").read_text()
    assert sorted(set(re.findall(r"\(examples/(\w+)\.py\)", page))) == [script.stem for script in SCRIPTS]
    pictures = {path.stem: path for path in (DOCS / "examples" / "images").iterdir()}
    assert sorted(pictures) == [script.stem for script in SCRIPTS]
    assert all(path.stat().st_size <= LARGEST_PICTURE for path in pictures.values())


def test_scripts_are_short_notebooks():
    for script in SCRIPTS:
        text = script.read_text()
        assert text.count("\n") < 80, script.name
        assert text.startswith("# ---\n# jupytext:"), script.name
        assert text.split("# %%")[1].startswith(" [markdown]"), script.name
        assert stated(script), script.name
