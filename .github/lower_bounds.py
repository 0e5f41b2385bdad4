"""Prints the lower bounds of the dependencies and of the extra `test` in `pyproject.toml` as constraints for pip."""

import re
import sys
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
for requirement in project["dependencies"] + project["optional-dependencies"]["test"]:
    if found := re.match(r"([\w-]+)(?:\[[\w,]+\])?>=([\w.]+)", requirement):
        sys.stdout.write(f"{found[1]}=={found[2]}\n")
