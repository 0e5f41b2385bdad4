"""Commands begin without modules that take tenths of a second to import and that a run without meshes does not use."""

import subprocess
import sys

_PROGRAM = """
import sys
import jaxfilters.trackers.app.cli
import jaxfilters.trackers.hand_depth.command
import jaxfilters.trackers.people.command
print(sorted({"networkx", "scipy", "trimesh"} & set(sys.modules)))
"""


def test_people_and_hands_begin_without_trimesh_and_scipy():
    found = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
