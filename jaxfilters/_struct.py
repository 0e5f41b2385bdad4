"""One decorator for frozen dataclasses that JAX can take apart."""

from dataclasses import dataclass, field
from typing import TypeVar, dataclass_transform, no_type_check

import jax

Class = TypeVar("Class")


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def pytree_dataclass(cls: type[Class]) -> type[Class]:
    """Make a class a frozen dataclass and a pytree.

    Fields are leaves or subtrees; those declared as `field(metadata={"static": True})` are part of the tree's
    structure. Types are not checked at run time, because JAX rebuilds such
    classes with placeholders in place of arrays.
    """
    return jax.tree_util.register_dataclass(dataclass(frozen=True)(no_type_check(cls)))
