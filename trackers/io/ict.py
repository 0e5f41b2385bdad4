"""The ICT face model on disk (`jaxfilters.models.synthetic.ict_face`), as a user gives it."""

from pathlib import Path

from jaxfilters.models.synthetic.ict_face import ICT_FILES, IctModel, ict_model
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.npz import read_npz


def open_ict(folder: Path) -> IctModel:
    """The face model in a folder.

    Raises:
        InputError: the folder lacks one of the two files, one of them lacks an array or cannot be read, or their arrays
            do not fit each other.
    """
    found = []
    for name, needed in ICT_FILES.items():
        wanted = f"expected a file of the ICT face model with {', '.join(needed)}"
        found.append(read_npz(folder / name, wanted, needed))
        if missing := set(needed) - set(found[-1]):
            raise InputError(f"{folder / name}: without {', '.join(sorted(missing))}; {wanted}.")
    try:
        return ict_model(*found)
    except ValueError as error:
        raise InputError(f"{folder}: {error}") from None
