"""The files that this package is made of, as a digest: what was computed by other code is not the same."""

import hashlib
import importlib.util
from pathlib import Path

PACKAGE = "jaxfilters"
SUBPACKAGES = ("models", "trackers", "benchmarks")
"""Which need not lie in the folder of the package, as in an editable installation."""
CODE_AND_DATA = {".py", ".npz"}


def package_folders() -> list[Path]:
    """The folder of this package and of each of `SUBPACKAGES`; those of a wheel lie within the first."""
    specs = [importlib.util.find_spec(name) for name in (PACKAGE, *(f"{PACKAGE}.{name}" for name in SUBPACKAGES))]
    places = [spec.submodule_search_locations for spec in specs if spec and spec.submodule_search_locations]
    # The first place of the package itself: an editable installation adds the folder of the whole repository.
    return [Path(next(iter(place))) for place in places]


def digest_of(folders: list[Path], before_s: float) -> bytes | None:
    """Digest of the code and the data in folders; None where there is none, or a file is as new as `before_s`.

    A file that was written after the import is not what runs.
    """
    digest, is_empty = hashlib.sha256(), True
    try:
        for i, folder in enumerate(folders):
            for file in sorted(path for path in folder.rglob("*") if path.suffix in CODE_AND_DATA):
                if max(file.stat().st_mtime, file.stat().st_ctime) >= before_s:
                    return None
                digest.update(f"{i} {file.relative_to(folder)}".encode())
                digest.update(hashlib.sha256(file.read_bytes()).digest())
                is_empty = False
    except OSError:
        return None
    return None if is_empty else digest.digest()
