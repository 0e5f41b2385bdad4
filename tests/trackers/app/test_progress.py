"""Progress in a log file, where the number of frames is a claim."""

from jaxfilters.trackers.app.progress import ProgressLine


def test_more_frames_than_a_file_claims_are_counted_without_a_total(capsys):
    with ProgressLine("tracking", 3) as line:
        for done in range(1, 700):
            line.show(done, "2 people")
    lines = capsys.readouterr().err.splitlines()
    assert lines[2] == "tracking 3/3  2 people"
    assert [one.split()[1] for one in lines[3:]] == ["303", "603"]
