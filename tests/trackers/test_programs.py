"""How many programs the command compiles or loads until a system has tracked its synthetic recording."""

import subprocess
import sys
from pathlib import Path

import pytest

MOST_PROGRAMS = {"articulated": 36, "people": 28, "fingertips": 14}
"""Two more than there are now. Every program is traced, lowered and loaded at every start, 20 ms for the smallest. The
other three systems (hand-depth 40, head-stereo 35, head-mono 42 programs) compile for 20 to 35 s each: too long."""
COUNTED = """
import sys, jax.monitoring
from jaxfilters.trackers.app.cli import main
programs = []
def count(name, seconds, **more):
    if name.endswith("/backend_compile_duration"):
        programs.append(more.get("fun_name"))
jax.monitoring.register_event_duration_secs_listener(count)
code = main(sys.argv[1:])
print("programs:", *sorted(map(str, programs)))
sys.exit(code)
"""


@pytest.mark.system
@pytest.mark.parametrize("name", MOST_PROGRAMS)
def test_a_start_takes_few_programs(name: str, tmp_path: Path) -> None:
    short = [] if name == "articulated" else ["--seconds", "2"]
    command = [sys.executable, "-c", COUNTED, "track", name, *short, "--out", str(tmp_path / "out")]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    programs = done.stdout.partition("programs: ")[2].split()
    assert 0 < len(programs) <= MOST_PROGRAMS[name], programs
