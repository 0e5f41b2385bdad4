"""Configurations: fields read as settings, their checks, and the options of commands that follow from them."""

import argparse
from dataclasses import dataclass
from typing import Annotated

import pytest

from jaxfilters.trackers.app.options import _lowered, add_config, config_from_args
from jaxfilters.trackers.configuration import OneOf, check, settings_of


@dataclass(frozen=True)
class Config:
    """A configuration with every kind of field."""

    method: Annotated[str, OneOf("fast", "exact")] = "fast"
    """How it is computed; exact
    takes longer."""
    rows: int | None = None
    """Number of rows (default: all, 100 %)."""
    gain: float = 0.5
    smooth: bool = True
    """Smooth the result."""
    sizes: tuple[int, ...] = (1, 2)
    """No setting: neither a number nor a word."""

    def __post_init__(self) -> None:
        check(self, at_least={"rows": 1, "gain": 0})


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="x")
    add_config(parser, Config, "method", "rows", "gain", "smooth")
    return parser


def test_fields_are_read_with_their_types_choices_defaults_and_docstrings():
    settings = settings_of(Config)
    assert list(settings) == ["method", "rows", "gain", "smooth"]
    assert settings["method"] == ("method", str, ("fast", "exact"), "fast", "How it is computed; exact takes longer.")
    assert settings["rows"][1:4] == (int, (), None)
    assert settings["gain"] == ("gain", float, (), 0.5, "")
    assert settings["smooth"].kind is bool


def test_options_that_are_not_given_keep_the_defaults():
    assert config_from_args(Config(), _parser().parse_args([])) == Config()


def test_options_reach_their_fields():
    given = _parser().parse_args(["--method", "exact", "--rows", "3", "--gain", "2", "--no-smooth"])
    assert config_from_args(Config(), given) == Config("exact", 3, 2.0, False)


def test_lines_of_help_begin_with_a_small_letter_unless_they_begin_with_a_name():
    for text, expected in (
        ("Degrees of freedom.", "degrees of freedom."),
        ("Rao-Blackwellized filter.", "Rao-Blackwellized filter."),
        ("RGB images.", "RGB images."),
        ("A", "a"),
        ("", ""),
    ):
        assert _lowered(text) == expected


def test_the_help_is_made_of_docstrings_and_defaults():
    text = " ".join(_parser().format_help().split())
    assert "--method {fast,exact} how it is computed; exact takes longer (default: fast)" in text
    assert "number of rows (default: all, 100 %)" in text
    assert "--smooth, --no-smooth smooth the result (default: smooth)" in text


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"method": "slow"}, "method must be one of fast, exact; got 'slow'"),
        ({"rows": 0}, "rows must be at least 1; got 0"),
        ({"gain": float("nan")}, "gain must be at least 0; got nan"),
    ],
)
def test_what_fields_do_not_allow_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Config(**values)
