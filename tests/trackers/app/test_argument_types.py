"""Numbers on the command line that would let a run go on for ever are refused before it begins."""

import argparse
import io
import math
from contextlib import redirect_stderr

import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from jaxfilters.trackers.app import argument_types, cli
from jaxfilters.trackers.app.argument_types import positive_number
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import open_video

TYPES = {
    argument_types.positive_number: lambda value: math.isfinite(value) and value > 0,
    argument_types.finite_number: math.isfinite,
    argument_types.positive_integer: lambda value: 1 <= value < 10**18,
    argument_types.seed: lambda value: 0 <= value < 2**32,
    argument_types.image_size: lambda value: min(value) >= 1 and value[0] * value[1] <= 128 * 2**20,
}
"""What each type promises of its value."""
PARSER = cli._parser()
RATES = [
    ("track", "people", "a.avi", "--camera", "c.json", "--out", "out", "--fps"),
    ("track", "head-stereo", "a.avi", "b.avi", "--out", "out", "--fps"),
    ("track", "head-mono", "a.avi", "--out", "out", "--fps"),
    ("track", "fingertips", "a.avi", "--out", "out", "--fps"),
    ("track", "articulated", "a.npz", "--out", "out", "--fps"),
    ("track", "people", "a.avi", "--camera", "c.json", "--out", "out", "--seconds"),
    ("fit", "noise", "tips.csv", "--fps"),
]


@pytest.mark.parametrize("command", RATES, ids=lambda command: "-".join([command[1], command[-1].strip("-")]))
@pytest.mark.parametrize("value", ["-1", "0", "nan", "inf", "fast"])
def test_rates_and_durations_are_finite_and_positive(command, value, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([*command[:-1], f"{command[-1]}={value}"])
    assert stopped.value.code == 2
    assert f"expected a finite number above 0; got {value}" in capsys.readouterr().err


@pytest.mark.parametrize("fps", [-1.0, 0.0, float("nan"), float("inf")])
def test_videos_are_opened_at_no_other_rate(tmp_path, fps):
    with pytest.raises(InputError, match="fps must be finite and above 0"):
        open_video(str(tmp_path), fps=fps)


def test_a_rate_is_read():
    assert positive_number("29.97") == 29.97


NUMBERS = st.one_of(
    st.floats(width=64).map(str),
    st.integers(-(10**22), 10**22).map(str),
    st.text(max_size=60),
    st.sampled_from(
        ["1" * 5000, "9" * 30, "nan", "-inf", "1e999", "1_000", "\u0663", "²", "0x10", "640x480", "x", "1x" * 900]
    ),
)


def reason_against(read, text):
    """What a type says against a text, None if it takes it."""
    try:
        value = read(text)
    except argparse.ArgumentTypeError as error:
        return str(error)
    assert TYPES[read](value)
    return None


@seed(1)
@settings(max_examples=40, deadline=None, database=None)
@given(NUMBERS)
@pytest.mark.parametrize("read", TYPES, ids=lambda read: read.__name__)
def test_a_type_gives_a_value_in_its_range_or_a_short_reason(read, text):
    """Nothing but the error of `argparse` is raised, whatever the text."""
    reason = reason_against(read, text)
    assert reason is None or (len(reason) < 150 and reason.isprintable())


OPTIONS = [
    ("track", "hand-depth", "--out", "o", "--seed"),
    ("track", "articulated", "a.npz", "--out", "o", "--image-size"),
    ("track", "people", "a.avi", "--out", "o", "--seconds"),
    ("track", "head-mono", "a.avi", "--out", "o", "--seed"),
    ("track", "fingertips", "a.avi", "--out", "o", "--fps"),
    ("calibrate", "charuco", "a.png", "--out", "o", "--squares", "7x5", "--marker-m", "0.1", "--square-m"),
    ("fit", "face-model", "--out", "o", "--identities"),
    ("fit", "gestures", "--out", "o", "--states"),
    ("recognise", "default", "--margin"),
]


def last_line(parser, arguments):
    """What the parser says against arguments at the end, None if it takes them."""
    said = io.StringIO()
    with redirect_stderr(said):
        try:
            parser.parse_args(arguments)
        except SystemExit as stopped:
            code = stopped.code
        else:
            return None
    assert code == 2
    return said.getvalue().splitlines()[-1]


@seed(2)
@settings(max_examples=150, deadline=None, database=None)
@given(st.sampled_from(OPTIONS), NUMBERS)
def test_the_parser_takes_a_value_or_names_the_option_in_a_short_line(options, text):
    *others, last = options
    said = last_line(PARSER, [*others, f"{last}={text}"])
    assert said is None or (last in said and len(said) < 300)
