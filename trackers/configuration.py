"""Configurations of trackers: frozen dataclasses whose fields say once what they are, for Python and for commands.

The annotation of a field gives its type, `OneOf` in it its choices, and the docstring under it its meaning. The checks
here and `jaxfilters.trackers.app.options.add_config` read them.
"""

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Mapping
from types import UnionType
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints


class OneOf:
    """The words that a field of type `str` may be: `filter: Annotated[str, OneOf("rbpf", "pf")] = "rbpf"`."""

    def __init__(self, *words: str) -> None:
        self.words = words


class Setting(NamedTuple):
    """A field of a configuration."""

    name: str
    kind: type
    """`int`, `float`, `bool` or `str`."""
    choices: tuple[str, ...]
    """Its values, if they are words; otherwise empty."""
    default: Any
    """None where something else decides unless it is given."""
    meaning: str
    """Its docstring, in one line."""


def settings_of(config: type) -> dict[str, Setting]:
    """The fields of a configuration that are numbers, words or truth values, by name.

    Args:
        config: A dataclass with a default for each of these fields. One that may be None has the annotation
            `int | None`, in this order.
    """
    hints, meanings = get_type_hints(config, include_extras=True), _docstrings(config)
    found = {}
    for field in dataclasses.fields(config):
        hint = hints[field.name]
        choices = next((part.words for part in get_args(hint) if isinstance(part, OneOf)), ())
        kind = get_args(hint)[0] if get_origin(hint) in (Annotated, UnionType) else hint
        if kind in (int, float, bool, str):
            found[field.name] = Setting(field.name, kind, choices, field.default, meanings.get(field.name, ""))
    return found


def check(config: Any, *, at_least: Mapping[str, int | float] | None = None) -> None:
    """Refuse a configuration with a value that its fields do not allow.

    Args:
        config: An instance of a dataclass, as its `__post_init__` has it.
        at_least: The least values of numbers, by field. None, where a field allows it, is not compared.

    Raises:
        ValueError: A word is none of the choices of its field, or a number is too small or NaN. The message names
            the field, what was expected and what came.
    """
    for name, setting in settings_of(type(config)).items():
        value = getattr(config, name)
        if setting.choices and value not in setting.choices:
            raise ValueError(f"{name} must be one of {', '.join(setting.choices)}; got {value!r}.")
    for name, least in (at_least or {}).items():
        value = getattr(config, name)
        if value is not None and not value >= least:
            raise ValueError(f"{name} must be at least {least:g}; got {value}.")


def _docstrings(config: type) -> dict[str, str]:
    """The string under each field, which Python itself does not keep."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(config))).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, after in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            found[ast.unparse(field.target)] = " ".join(str(after.value.value).split())
    return found
