"""`fit gestures` and `recognise` from end to end, and what they refuse."""

import csv

import jax
import numpy as np
import pytest

from jaxfilters.models.gesture import learning
from jaxfilters.trackers.app.cli import FAILURE, main
from jaxfilters.trackers.gestures import command as gesture_command
from jaxfilters.trackers.io.gesture_models import default_symbols, read_symbols

CORNERS = {"V": [(0, 0), (1, 2), (2, 0)], "L": [(0, 0), (0, 2), (1, 2)], "Z": [(0, 0), (2, 0), (0, 2), (2, 2)]}


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """`main` sets XLA_FLAGS for its process."""
    monkeypatch.setenv("XLA_FLAGS", "")


def run(*arguments):
    return main([str(argument) for argument in arguments])


def written(path, names, people=("Ann", "Bob"), trials=3, axes=("x", "y")):
    """A file of strokes, each with its writer's proportions."""
    rng = np.random.default_rng(0)
    rows = [["stroke", "label", "person", *axes]]
    for name in names:
        for person in people:
            for trial in range(trials):
                corners = np.array(CORNERS[name], float)
                at = np.linspace(0, len(corners) - 1, 30)
                points = np.stack([np.interp(at, np.arange(len(corners)), corners[:, k]) for k in range(2)], axis=1)
                points = points * rng.uniform(0.8, 1.2, 2) + rng.normal(0, 0.02, points.shape)
                points = np.concatenate([points, points[:, :1]], axis=1)[:, : len(axes)]
                rows += [[f"{name}{person}{trial}", name, person, *point] for point in points]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return path


@pytest.mark.system
def test_symbols_are_learnt_added_and_recognised(tmp_path, capsys):
    data, model, more = written(tmp_path / "vl.csv", "VL"), tmp_path / "vl.npz", tmp_path / "vlz.npz"
    assert run("fit", "gestures", data, "--out", model, "--states", 6, "--held-out", "person") == 0
    message = capsys.readouterr().out
    assert "vl.csv: 12 strokes of 2 symbols" in message
    assert "people left out in turn: 100.00 % right if none is rejected; 100.00 % accepted" in message
    assert "Ann: 100.0 % of 6; 100.00 % accepted, 100.00 % of these right" in message
    five = written(tmp_path / "z.csv", "Z", people=("Ann",), trials=5)
    assert run("fit", "gestures", five, "--out", more, "--add", model) == 0
    assert "3 symbols, 3 models of 6 states" in capsys.readouterr().out
    found = read_symbols(more)
    assert (found.symbols.names, found.source) == (("L", "V", "Z"), "vl.csv; z.csv")

    everything = written(tmp_path / "all.csv", "ZLV", trials=2)
    with everything.open("a") as file:
        file.write("dot,,,1,1\nhole,,,nan,1\n")
    assert run("recognise", more, everything, "--out", tmp_path / "out" / "table.csv") == 0
    message = capsys.readouterr().out
    assert "14 strokes, 2 rejected; of 12 with a label 100.00 % right if none is rejected; 100.00 % accepted" in message
    with (tmp_path / "out" / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["symbol"] for row in rows] == ["Z"] * 4 + ["L"] * 4 + ["V"] * 4 + [""] * 2
    assert all(0.5 < float(row["confidence"]) <= 1 for row in rows[:12])
    assert rows[-1] == {"stroke": "hole", "symbol": "", "confidence": "", "lead_nats": "", "label": ""}


@pytest.mark.parametrize("more", [(), ("--held-out", "person")])
def test_added_symbols_are_judged_by_models_like_those_that_are_added(tmp_path, capsys, monkeypatch, more):
    """With the states and the floor of variances of the model to which they are added."""
    asked, file, data = [], default_symbols(), written(tmp_path / "vl.csv", "VL", trials=5)

    def learned(*arguments):
        asked.append(arguments[-1])
        return file.symbols

    def stop(*arguments):
        asked.append(arguments[-1])
        raise ValueError("enough is known")

    monkeypatch.setattr(learning, "_scores", stop)
    monkeypatch.setattr(gesture_command, "learn_strokes", learned)
    command = ("fit", "gestures", data, "--out", tmp_path / "m.npz", "--add", "default", "--ways", 2, *more)
    assert run(*command) == FAILURE
    assert "enough is known" in capsys.readouterr().err
    assert asked == [learning.Settings(file.symbols.models.log_initial.shape[-1], 2, file.min_variance)] * 2


@pytest.mark.system
def test_without_data_symbols_are_drawn(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(gesture_command, "_SHOWN_TRIALS", 1)
    assert run("recognise", "default", "--margin", 0.3) == 0
    message = capsys.readouterr().out.splitlines()
    assert message[0].split() == list(gesture_command.COLUMNS)
    assert message[-1] == (
        "24 strokes, 0 rejected; of 24 with a label 100.00 % right if none is rejected; 100.00 % accepted, "
        "100.00 % of these right"
    )


@pytest.mark.optimised
@pytest.mark.system
def test_without_data_it_makes_the_model_of_the_package(tmp_path, capsys):
    assert run("fit", "gestures", "--out", tmp_path / "model.npz") == 0
    assert "24 symbols" in capsys.readouterr().out
    made, shipped = read_symbols(tmp_path / "model.npz"), default_symbols()
    assert made[1:] == shipped[1:]
    assert made.symbols.names == shipped.symbols.names
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-3), made.symbols.models, shipped.symbols.models)


@pytest.mark.system
def test_what_cannot_be_used_is_refused_in_a_line(tmp_path, capsys):
    flat, model = written(tmp_path / "flat.csv", "V"), tmp_path / "flat.npz"
    deep = written(tmp_path / "deep.csv", "VL", axes=("x", "y", "z"))
    nameless = tmp_path / "nameless.csv"
    nameless.write_text("stroke,x,y\na,1,2\na,2,3\n")
    assert run("fit", "gestures", flat, "--out", model) == 0
    assert run("fit", "gestures", deep, "--out", tmp_path / "deep.npz") == 0
    capsys.readouterr()
    for arguments, word in (
        (("fit", "gestures", nameless, "--out", model), "stroke a has no label"),
        (("fit", "gestures", flat, "--out", model, "--add", model), "new names"),
        (("fit", "gestures", deep, "--out", model, "--add", model), "2 dimensions (8 features a point), DATA are"),
        (("fit", "gestures", deep, "--out", model, "--add", "default"), "default has models of the shapes of"),
        (("fit", "gestures", tmp_path / "none.csv", "--out", model), "no such file"),
        (("recognise", model, deep), "positions of 2 dimensions"),
        (("recognise", tmp_path / "deep.npz"), "in space"),
        (("recognise", flat), "flat.csv"),
    ):
        assert run(*arguments) == FAILURE
        assert word in capsys.readouterr().err


@pytest.mark.system
def test_one_person_cannot_be_left_out(tmp_path, capsys):
    data = written(tmp_path / "one.csv", "VL", people=("Ann",))
    assert run("fit", "gestures", data, "--out", tmp_path / "model.npz", "--held-out", "person") == FAILURE
    assert "two or more" in capsys.readouterr().err
