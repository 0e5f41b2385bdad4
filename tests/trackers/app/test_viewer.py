"""`jaxfilters view`: what the page holds, and in a headless browser what it shows."""

import csv
import json
import shutil
import subprocess

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.app import viewer
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.viewer import page_of

FRAMES = 12


def write_results(folder, frames=range(FRAMES), *, name="track.csv", first_video=0, video_frames=FRAMES):
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / name).open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("frame", "time_s", "x_m", "yaw_rad", "x_std_m", "yaw_std_rad", "status"))
        rows.writerows((i, i / 10, 0.5 * i, "nan" if i == 3 else 0.1, 0.25, 0.01, "tracking") for i in frames)
    (folder / "report.json").write_text(json.dumps({"input": "</script><b>x", "status": {"lost": 2}, "rate": None}))
    path = folder / (f"overlay_from_{first_video}.mp4" if first_video else "overlay.mp4")
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for i in range(video_frames):
        video.write(np.full((48, 64, 3), 10 * i, np.uint8))
    video.release()
    return folder


def data_of(page):
    return json.loads(page.partition('<script id="data" type="application/json">')[2].partition("</script>")[0])


def test_a_page_holds_all_results_and_needs_no_network(tmp_path):
    page = page_of(write_results(tmp_path / "run"))
    assert "http" not in page
    assert page.count("</script>") == 2
    data = data_of(page)
    assert data["times_s"] == pytest.approx(np.arange(FRAMES) / 10)
    assert [picture["frame"] for picture in data["pictures"]] == list(range(FRAMES))
    charts = {chart["title"]: chart["lines"] for chart in data["charts"]}
    assert set(charts) == {"x, m", "yaw, rad"}
    (x,), (yaw,) = charts["x, m"], charts["yaw, rad"]
    assert (x["y"][2], x["std"][2], yaw["y"][3], yaw["std"][4]) == (1.0, 0.25, None, 0.01)
    assert ["status.lost", "2"] in data["report"]
    assert data["plan"] is None


def test_long_videos_are_thinned_out_and_resumed_ones_joined(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer, "MOST_PICTURES", 8)
    write_results(tmp_path, range(2 * FRAMES))
    write_results(tmp_path, range(2 * FRAMES), first_video=FRAMES)
    data = data_of(page_of(tmp_path))
    assert [picture["frame"] for picture in data["pictures"]] == list(range(0, 2 * FRAMES, 3))


def test_people_have_a_plan_and_a_line_each(tmp_path):
    rows = ["frame,id,x_m,y_m,score,status", "0,4,1,2,0.5,tracking", "1,4,1.5,2,0.5,predicted", "1,7,0,0,0.1,tracking"]
    (tmp_path / "track.csv").write_text("\n".join(rows))
    data = data_of(page_of(tmp_path))
    assert data["plan"] == [
        {"name": "4", "frame": [0, 1], "x": [1.0, 1.5], "y": [2.0, 2.0]},
        {"name": "7", "frame": [1], "x": [0.0], "y": [0.0]},
    ]
    assert [line["name"] for line in data["charts"][0]["lines"]] == ["x 4", "x 7"]
    assert data["rows"][1] == [1, "4", "1.5", "2", "0.5", "predicted"]


@pytest.mark.parametrize(
    "text",
    [
        *(None, "", "a,b\n1,2", "frame,x_m\n0", "frame,x_m\n0.5,1", 'frame,x_m\n0,"1'),
        *("frame,x_m\n-1,1", "frame,x_m\n999999999999,1", f"frame,x_m\n{'9' * 5000},1"),
    ],
    ids=range(9),
)
def test_what_holds_no_results_is_refused(text, tmp_path, capsys):
    if text is not None:
        (tmp_path / "track.csv").write_text(text)
    code = main(["view", str(tmp_path), "--no-open"])
    message = capsys.readouterr().err
    assert (code, message.count("\n")) == (2, 1), message
    assert not (tmp_path / "view.html").exists()


def test_the_folder_of_a_page_is_made(tmp_path):
    page = tmp_path / "new" / "deeper" / "a.html"
    assert main(["view", str(write_results(tmp_path / "run")), "--no-open", "--out", str(page)]) == 0
    assert data_of(page.read_text())["title"] == "run"


def test_a_folder_whose_name_is_too_long_holds_no_results(capsys):
    assert main(["view", "n" * 3000, "--no-open"]) == 2
    message = capsys.readouterr().err
    assert message.endswith("nnn: expected a folder of results, with track.csv.\n")
    assert len(message) < 1100


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
HEADLESS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--dump-dom")
QUIET = ("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-proxy-server")
ASKS = """<script>setTimeout(() => {
  const handle = document.getElementById("slider");
  handle.value = 5;
  handle.dispatchEvent(new Event("input"));
  setTimeout(() => {
    const drawn = [...document.querySelectorAll("canvas")].map(c =>
      new Set(c.getContext("2d").getImageData(0, 0, c.width, c.height).data).size > 8);
    document.title = [document.getElementById("now").textContent, drawn.length, drawn.every(x => x),
      document.querySelector("img").naturalWidth, document.querySelectorAll("tr.now").length].join("|");
  }, 500);
}, 500)</script>"""


@pytest.mark.system
def test_a_browser_shows_the_chosen_frame(tmp_path):
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"needs a browser: one of {', '.join(BROWSERS)}")
    page = tmp_path / "a.html"
    assert main(["view", str(write_results(tmp_path / "run")), "--no-open", "--out", str(page)]) == 0
    page.write_text(page.read_text().replace("</body>", f"{ASKS}</body>"))
    own = (f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=5000")
    command = [browser, *HEADLESS, *QUIET, *own, page.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert "<title>frame 5, 0.50 s|2|true|64|1</title>" in shown.stdout, shown.stderr
