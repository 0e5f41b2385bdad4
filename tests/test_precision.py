"""Every product of floats asks for all digits: NVIDIA devices keep 10 bits of each factor where a program does not.

Read from the source here. Other tests trace filters and models and look at the products of their programs with the
fixture `products_at_default_precision`, which finds those inside of functions of JAX as well.
"""

import ast
import re
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from jaxfilters._full_precision import qr

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for folder in ("jaxfilters", "models", "trackers") for path in (ROOT / folder).rglob("*.py"))
PRODUCTS = {"einsum", "tensordot", "dot", "matmul", "inner", "vdot", "vecdot", "matvec", "vecmat", "dot_general"}
PRODUCTS |= {"batch_matmul", "conv", "conv_general_dilated", "conv_with_general_padding", "conv_transpose"}
PRODUCTS |= {"convolve", "correlate"}
TRACED = re.compile(r"\b(?:jnp|jax|lax)\.|\bArray\b(?! \|)")
"""What a function has in its text that computes with arrays of JAX."""
OF_NUMPY = {
    ("jaxfilters/gaussian/constraints/constant_rows.py", "_transition_along"),
    ("jaxfilters/gaussian/constraints/resolution.py", "check_resolution"),
    ("jaxfilters/plot.py", "track"),
    ("models/synthetic/room.py", "floor_camera"),
    ("models/synthetic/room.py", "looking"),
    ("trackers/head/stereo/registration.py", "_registration"),
    ("trackers/people/files.py", "_boxes"),
}
"""Functions that have `@` between arrays of NumPy, and compute with arrays of JAX as well."""


def outermost(tree):
    """Functions and methods; a function belongs to the one that it is defined in."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            yield node
        elif isinstance(node, ast.ClassDef):
            yield from outermost(node)


def calls_without_precision(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in PRODUCTS:
            of_jax = ast.unparse(node.func.value) in ("jnp", "lax", "jax.numpy", "jax.lax")
            if of_jax and not any(keyword.arg == "precision" for keyword in node.keywords):
                yield node.lineno


def operators_that_may_be_traced(tree, path):
    for function in outermost(tree):
        lines = [node.lineno for node in ast.walk(function) if isinstance(getattr(node, "op", None), ast.MatMult)]
        if lines and (path, function.name) not in OF_NUMPY and TRACED.search(ast.unparse(function)):
            yield from lines


def found_in(text, path=""):
    tree = ast.parse(text)
    return [*calls_without_precision(tree), *operators_that_may_be_traced(tree, path)]


def test_products_in_the_source_ask_for_full_precision():
    found = {path: found_in(path.read_text(), str(path.relative_to(ROOT))) for path in SOURCES}
    places = [f"{path.relative_to(ROOT)}:{line}" for path, lines in found.items() for line in lines]
    assert not places, f"products for which there is jaxfilters._full_precision: {places}"


@pytest.mark.parametrize("shape", [(4, 3), (2, 4, 4)])
def test_derivatives_of_a_qr_decomposition_are_those_of_jax_in_full_precision(products_at_default_precision, shape):
    A, dA = jax.random.normal(jax.random.key(0), (2, *shape))
    ours, theirs = (partial(jax.jvp, function, (A,), (dA,)) for function in (qr, lambda A: tuple(jnp.linalg.qr(A))))
    assert jax.tree.all(jax.tree.map(jnp.array_equal, ours(), theirs()))
    assert not products_at_default_precision(jax.grad(lambda A: qr(A)[0].sum()), A, own=False)
    assert products_at_default_precision(jax.grad(lambda A: jnp.linalg.qr(A)[0].sum()), A, own=False)


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("x = jnp.einsum('i,i', a, b)", [1]),
        ("x = jnp.einsum('i,i', a, b, precision='highest')", []),
        ("def f(a, b):\n    return jax.lax.dot_general(a, b, dims)", [2]),
        ("def f(a: Float[Array, '2'], b):\n    return a @ b", [2]),
        ("def f(a):\n    a = jnp.exp(a)\n    a @= a\n    return lambda b: a @ b", [3, 4]),
        ("def f(a: Float[np.ndarray, '2'], b):\n    return np.exp(a @ b)", []),
    ],
)
def test_the_rule_for_sources_finds_what_it_should(text, lines):
    assert sorted(found_in(text)) == lines


def test_traced_products_are_found_wherever_they_are(products_at_default_precision):
    """In loops, branches, derivatives of one's own, and functions that JAX or the caller compiles."""
    product, x = lambda a: a @ a, jnp.eye(2)

    @jax.custom_jvp
    def custom(a):
        return a

    custom.defjvp(lambda primals, tangents: (primals[0], tangents[0] @ primals[0]))
    cases = [
        product,
        jax.jit(product),
        jax.vmap(lambda row: row @ x),
        jax.grad(lambda a: custom(a).sum()),
        lambda a: jax.lax.scan(lambda c, _: (product(c), None), a, None, length=2),
        lambda a: jax.lax.cond(a[0, 0] > 0, product, lambda a: a, a),
        lambda a: jax.lax.while_loop(lambda c: c[0, 0] < 0, product, a),
        lambda a: jnp.tensordot(a, a, 1),
        lambda a: jax.scipy.signal.convolve(a, a),
    ]
    for case in cases:
        assert [Path(line.rsplit(":", 1)[0]) for line in set(products_at_default_precision(case, x, own=False))] == [
            Path(__file__)
        ]
    full = lambda a: jnp.matmul(a, a, precision="highest") + (jnp.arange(2) @ jnp.arange(2))
    assert not products_at_default_precision(jax.grad(lambda a: full(a).sum()), x, own=False)
