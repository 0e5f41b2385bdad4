"""Models of symbols on disk, and the one that comes with the package.

An `.npz` with the arrays `owner` (m,), the symbol that each model is a variant of; `log_initial` (m, Q) and
`log_transition` (m, Q, Q) of the models; those of their emission, and `header`, a text in JSON:

    {"format": "jaxfilters symbols", "version": 1, "names": [...], "emission": "shape" or "codes",
     "settings": {...}, "source": "what it was estimated from", "parameters": {...}}

Where confidences and margins were fitted to strokes of people left out, `margins` (k,) has the nats a point by which
each symbol has to beat the threshold model, and `settings` hold `sharpness`, the share of a log-likelihood that counts,
and `lapse`, the probability that a stroke may be any symbol.

States of kind `shape` have `mean` and `variance` (m, Q, 3 d + 2) of the features of strokes in d dimensions, those of
kind `codes` `log_codes` (m, Q, 17) and `log_counts` (m, Q, 6). `jaxfilters fit gestures` writes such files.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxfilters import hmm
from jaxfilters.hmm import HiddenMarkovModel
from jaxfilters.models.gesture.codes import MOST_TIPS, STILL
from jaxfilters.models.gesture.symbols import Symbols
from jaxfilters.trackers.io.checkpoint import write_npz
from jaxfilters.trackers.io.errors import InputError, OutputError, shown
from jaxfilters.trackers.io.input_files import LARGEST, too_large
from jaxfilters.trackers.io.npz import read_header, read_npz

FORMAT, VERSION = "jaxfilters symbols", 1
DEFAULT_FILE = Path(__file__).with_name("gesture_model.npz")
"""What `jaxfilters fit gestures` makes without data: twelve shapes, drawn by writers of the generator."""
SHAPE, CODES = "shape", "codes"
_ARRAYS = {SHAPE: ("mean", "variance"), CODES: ("log_codes", "log_counts")}
_SETTINGS = {SHAPE: "min_variance", CODES: "pseudo_count"}
_SOFTNESS = {"sharpness": LARGEST, "lapse": 1.0}
"""Settings of confidences, and how large they may be."""
_WANTED = "expected an .npz of `jaxfilters fit gestures`"


class SymbolsFile(NamedTuple):
    """Models of symbols, and what is known of them."""

    symbols: Symbols
    source: str
    """What it was estimated from."""
    parameters: dict[str, Any]
    """How."""

    @property
    def dimensions(self) -> int:
        """Of strokes that the models know; 0 for models of direction codes."""
        emission = self.symbols.models.emission
        return (emission.mean.shape[-1] - 2) // 3 if isinstance(emission, hmm.DiagonalGaussian) else 0

    @property
    def min_variance(self) -> float | None:
        """Floor of the variances of features, with which they were trained; `None` for models of direction codes."""
        emission = self.symbols.models.emission
        return emission.min_variance if isinstance(emission, hmm.DiagonalGaussian) else None


def write_symbols(path: str | Path, file: SymbolsFile) -> None:
    """Write models; their folder is made if need be.

    Raises:
        OutputError: the file cannot be written.
    """
    models = file.symbols.models
    emission: Any = models.emission
    if isinstance(emission, hmm.DiagonalGaussian):
        kind, values, setting = SHAPE, (emission.mean, emission.variance), emission.min_variance
    else:
        directions, tips = emission.parts
        kind, values = CODES, (directions.log_probability, tips.log_probability)
        setting = directions.pseudo_count
    margins = file.symbols.margins
    softness = {name: float(value) for name in _SOFTNESS if (value := getattr(file.symbols, name)) is not None}
    header = {
        "format": FORMAT,
        "version": VERSION,
        "names": list(file.symbols.names),
        "emission": kind,
        "settings": {_SETTINGS[kind]: setting} | softness,
        "source": file.source,
        "parameters": file.parameters,
    }
    arrays = {
        "header": np.asarray(json.dumps(header, allow_nan=False)),
        "owner": np.asarray(file.symbols.owner, np.int32),
        "log_initial": np.asarray(models.log_initial, np.float32),
        "log_transition": np.asarray(models.log_transition, np.float32),
        **{name: np.asarray(value, np.float32) for name, value in zip(_ARRAYS[kind], values, strict=True)},
        **({} if margins is None else {"margins": np.asarray(margins, np.float32)}),
    }
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_npz(Path(path), arrays)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def read_symbols(path: str | Path) -> SymbolsFile:
    """Models as they were written, in JAX's default precision.

    Raises:
        InputError: an unreadable or foreign file, another version, an unknown kind of emission, or arrays that do not
            fit each other or hold what no model has.
    """
    path = Path(path)
    arrays, header = _read(path)
    kind, names = header.get("emission"), header.get("names")
    if not isinstance(kind, str) or kind not in _ARRAYS:
        raise InputError(f"{path}: emission must be one of {', '.join(_ARRAYS)}; got {shown(kind)}.")
    are_words = isinstance(names, list) and all(isinstance(name, str) for name in names)
    if not names or not are_words or len(set(names)) != len(names):
        raise InputError(f"{path}: names must be of one symbol or more, none twice; got {shown(names)}.")
    _check(arrays, kind, len(names), path)
    settings = header.get("settings")
    setting = settings.get(_SETTINGS[kind]) if isinstance(settings, dict) else None
    if not isinstance(setting, int | float) or not 0 <= setting <= LARGEST:
        raise InputError(f"{path}: settings must say {_SETTINGS[kind]}, not negative; got {shown(setting)}.")
    first, second = (jnp.asarray(arrays[name], float) for name in _ARRAYS[kind])
    emission: hmm.Emission
    if kind == SHAPE:
        emission = hmm.DiagonalGaussian(first, second, float(setting))
    else:
        emission = hmm.Independent((hmm.Codes(first, float(setting)), hmm.Codes(second, float(setting))))
    models = HiddenMarkovModel(
        jnp.asarray(arrays["log_initial"], float), jnp.asarray(arrays["log_transition"], float), emission
    )
    softness = {name: settings.get(name) if isinstance(settings, dict) else None for name in _SOFTNESS}
    for name, value in softness.items():
        if value is not None and not (isinstance(value, int | float) and 0 < value <= _SOFTNESS[name]):
            raise InputError(f"{path}: {name} must be above 0 and at most {_SOFTNESS[name]:g}; got {shown(value)}.")
    margins = jnp.asarray(arrays["margins"], float) if "margins" in arrays else None
    owner = jnp.asarray(arrays["owner"], jnp.int32)
    symbols = Symbols(models, owner, tuple(str(name) for name in names), **softness, margins=margins)
    return SymbolsFile(symbols, str(header.get("source", "")), header["parameters"])


def default_symbols() -> SymbolsFile:
    """The models that come with the package: twelve shapes, each drawn with one finger or with two."""
    return read_symbols(DEFAULT_FILE)


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    arrays = read_npz(path, _WANTED)
    return arrays, read_header(arrays, path, _WANTED, FORMAT, VERSION)


def _check(arrays: dict[str, np.ndarray], kind: str, num_names: int, path: Path) -> None:
    needed = ("owner", "log_initial", "log_transition", *_ARRAYS[kind])
    if missing := [name for name in needed if name not in arrays]:
        raise InputError(f"{path}: without {', '.join(missing)}; {_WANTED}.")
    num_models, num_states = (*arrays["log_initial"].shape, 0, 0)[:2]
    symbols = (arrays[_ARRAYS[kind][0]].shape or (0,))[-1:]
    shapes = {
        "owner": (num_models,),
        "log_initial": (num_models, num_states),
        "log_transition": (num_models, num_states, num_states),
        "mean": (num_models, num_states, *symbols),
        "variance": (num_models, num_states, *symbols),
        "log_codes": (num_models, num_states, STILL),
        "log_counts": (num_models, num_states, MOST_TIPS + 1),
        "margins": (num_names,),
    }
    for name in (*needed, *(["margins"] if "margins" in arrays else [])):
        if arrays[name].shape != shapes[name] or arrays[name].dtype.kind != ("i" if name == "owner" else "f"):
            raise InputError(
                f"{path}: {name} must be numbers {shapes[name]}; got {arrays[name].shape} {arrays[name].dtype}."
            )
        logs = name.startswith("log")
        values = arrays[name]
        # The logarithm of an impossible transition is -inf; any other must be finite in single precision.
        finite = np.isneginf(values) if logs else np.zeros(values.shape, bool)
        finite |= ~np.isnan(values) & ~too_large(values)
        if not finite.all() or (logs and np.any(values > 1e-3)):
            raise InputError(f"{path}: {name} must be {'logarithms of probabilities' if logs else 'finite'}.")
    if set(arrays["owner"].tolist()) != set(range(num_names)):
        raise InputError(
            f"{path}: owner must give each of {num_names} symbols a model; got {shown(arrays['owner'].tolist())}."
        )
    if kind == SHAPE and ((symbols[0] - 2) not in (6, 9) or np.any(arrays["variance"] <= 0)):
        raise InputError(f"{path}: mean and variance must be of 8 or 11 features, variances positive.")
