"""Numbers on the command line that would let a run go on for ever are refused before it begins."""

import pytest

from jaxfilters.trackers.app.argument_types import positive_number
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import open_video

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
