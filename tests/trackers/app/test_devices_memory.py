"""Freed memory is kept for the next image."""

import platform
import subprocess
import sys

import pytest

PROGRAM = """
import resource
import numpy as np
from jaxfilters.trackers.app.devices import keep_freed_memory
keep_freed_memory()
def images(count):
    for _ in range(count):
        steps = [np.ones(500_000) for _ in range(10)]
        del steps
images(3)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
images(20)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are those of glibc")
def test_images_of_megabytes_take_no_new_pages() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True)
    assert int(done.stdout) < 100  # 200,000 without the settings
