"""Rotations and rigid motions: unit quaternions `(w, x, y, z)`, rotation vectors in radians, transforms in metres.

Every function takes one quaternion and is written as algebra on its components, so that
`vmap(in_axes=-1, out_axes=-1)` runs it as vector arithmetic over an ensemble. Values and first derivatives are finite
at the identity and at rotations by pi. All functions raise a ValueError, when they are traced, if a quaternion does not
have four components or a vector three.

Examples:
    >>> import jax.numpy as jnp
    >>> from jaxfilters.math import lie
    >>> q = lie.so3_exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
    >>> print(lie.quaternion_to_matrix(q).round(3)[:, 0])
    [0. 1. 0.]
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters import weights
from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass

# Below this squared tangent of half the angle, the first neglected term of the series is less than float64 rounding.
_SMALL = 1e-4


def _quaternion(name: str, q: Array) -> Array:
    if jnp.shape(q)[:1] != (4,):
        raise ValueError(f"{name} must be a quaternion (4,), (w, x, y, z); got {jnp.shape(q)}.")
    return q


def _vector(name: str, v: Array) -> Array:
    if jnp.shape(v)[:1] != (3,):
        raise ValueError(f"{name} must be a vector (3,); got {jnp.shape(v)}.")
    return v


def quaternion_multiply(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Hamilton product `p q`: the rotation `q` followed by the rotation `p`.

    Examples:
        Two quarter turns about z are a half turn.

        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> quarter = lie.so3_exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
        >>> print(abs(lie.quaternion_multiply(quarter, quarter)).round(3))
        [0. 0. 0. 1.]
    """
    pw, px, py, pz = _quaternion("p", p)
    qw, qx, qy, qz = _quaternion("q", q)
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )


def quaternion_conjugate(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Inverse of a unit quaternion.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> q = lie.so3_exp(jnp.array([0.3, -0.2, 0.5]))
        >>> print(lie.so3_log(lie.quaternion_conjugate(q)).round(3))
        [-0.3  0.2 -0.5]
    """
    w, x, y, z = _quaternion("q", q)
    return jnp.stack([w, -x, -y, -z])


def quaternion_normalize(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """The quaternion `q` divided by its norm; NaN for the zero quaternion.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> print(lie.quaternion_normalize(jnp.array([0.0, 3.0, 4.0, 0.0])))
        [0.  0.6 0.8 0. ]
    """
    w, x, y, z = _quaternion("q", q)
    # Scaled first, because in float32 the sum of squares underflows for norms below 1e-19.
    scale = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(abs(w), abs(x)), jnp.maximum(abs(y), abs(z))))
    w, x, y, z = w / scale, x / scale, y / scale, z / scale
    inverse_norm = jax.lax.rsqrt(w * w + x * x + y * y + z * z)
    return jnp.stack([w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm])


def quaternion_to_matrix(q: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """The rotation matrix of a unit quaternion.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> print(lie.quaternion_to_matrix(jnp.array([0.0, 1.0, 0.0, 0.0])))
        [[ 1.  0.  0.]
         [ 0. -1.  0.]
         [ 0.  0. -1.]]
    """
    w, x, y, z = _quaternion("q", q)
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def quaternion_from_matrix(R: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """The unit quaternion of a rotation matrix, with `w >= 0`.

    Of the four vectors `4 q_k q` that a rotation matrix determines, the longest is used, so that no angle leads to
    cancellation (S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1(3), 1978).

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> print(lie.quaternion_from_matrix(jnp.diag(jnp.array([1.0, -1.0, -1.0]))))
        [0. 1. 0. 0.]
    """
    if jnp.shape(R)[:2] != (3, 3):
        raise ValueError(f"R must be a rotation matrix (3, 3); got {jnp.shape(R)}.")
    (a, b, c), (d, e, f), (g, h, i) = R
    by_w = jnp.stack([1 + a + e + i, h - f, c - g, d - b])
    by_x = jnp.stack([h - f, 1 + a - e - i, b + d, c + g])
    by_y = jnp.stack([c - g, b + d, 1 - a + e - i, f + h])
    by_z = jnp.stack([d - b, c + g, f + h, 1 - a - e + i])
    first = jnp.where(by_x[1] > by_w[0], by_x, by_w)
    second = jnp.where(by_z[3] > by_y[2], by_z, by_y)
    first_size = jnp.where(by_x[1] > by_w[0], by_x[1], by_w[0])
    second_size = jnp.where(by_z[3] > by_y[2], by_z[3], by_y[2])
    return _with_positive_w(quaternion_normalize(jnp.where(second_size > first_size, second, first)))


def so3_exp(rotvec: Float[Array, "3"]) -> Float[Array, "4"]:
    """The unit quaternion of a rotation by `|rotvec|` radians about `rotvec`.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> [round(float(number), 3) for number in lie.so3_exp(jnp.array([2 * jnp.pi / 3, 0.0, 0.0]))]
        [0.5, 0.866, 0.0, 0.0]
    """
    x, y, z = _vector("rotvec", rotvec)
    angle2 = x * x + y * y + z * z
    small = angle2 < _SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, angle2))
    near_w = 1 - angle2 / 8 * (1 - angle2 / 48 * (1 - angle2 / 120))
    near_scale = 0.5 - angle2 / 48 * (1 - angle2 / 80 * (1 - angle2 / 168))
    w = jnp.where(small, near_w, jnp.cos(0.5 * angle))
    scale = jnp.where(small, near_scale, jnp.sin(0.5 * angle) / angle)
    return jnp.stack([w, scale * x, scale * y, scale * z])


def so3_log(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """The rotation vector, in radians and at most pi long, of a quaternion: the inverse of `so3_exp`.

    `q` and `-q` are the same rotation and give the same vector, except for a rotation by pi, for which both signs are
    valid. The norm of `q` has no influence.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> round(float(lie.so3_log(jnp.array([1.0, 1.0, 0.0, 0.0]))[0]), 3)
        1.571
    """
    w, x, y, z = _quaternion("q", q)
    sign = jnp.where(w < 0, -1.0, 1.0).astype(q.dtype)
    w, x, y, z = sign * w, sign * x, sign * y, sign * z
    sine2 = x * x + y * y + z * z
    small = sine2 < _SMALL * w * w
    # The half angle from its sine and cosine together, which is accurate near 0 and near pi.
    sine = jnp.sqrt(jnp.where(small, 1.0, sine2))
    cosine = jnp.where(small, w, 1.0)
    tangent2 = jnp.where(small, sine2, 0.0) / (cosine * cosine)
    near = 2 / cosine * (1 - tangent2 * (1 / 3 - tangent2 * (1 / 5 - tangent2 / 7)))
    scale = jnp.where(small, near, 2 * jnp.arctan2(sine, jnp.where(small, 1.0, w)) / sine)
    return jnp.stack([scale * x, scale * y, scale * z])


def so3_retract(q: Float[Array, "4"], rotvec: Float[Array, "3"]) -> Float[Array, "4"]:
    """The rotation `q` followed by `rotvec` in its own frame, `q exp(rotvec)`, as a unit quaternion.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> q = lie.so3_exp(jnp.array([0.2, 0.0, 0.0]))
        >>> print(lie.so3_log(lie.so3_retract(q, jnp.array([0.3, 0.0, 0.0]))).round(3))
        [0.5 0.  0. ]
    """
    return quaternion_normalize(quaternion_multiply(q, so3_exp(rotvec)))


def so3_local(q: Float[Array, "4"], p: Float[Array, "4"]) -> Float[Array, "3"]:
    """The rotation vector from `q` to `p`, `log(q^-1 p)` in radians: the inverse of `so3_retract`.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> q, p = (lie.so3_exp(jnp.array([angle, 0.0, 0.0])) for angle in (0.2, 0.5))
        >>> print(lie.so3_local(q, p).round(3))
        [0.3 0.  0. ]
    """
    return so3_log(quaternion_multiply(quaternion_conjugate(q), p))


def quaternion_mean(q: Float[Array, "4 n"], log_weights: Float[Array, " n"]) -> Float[Array, "4"]:
    """The weighted mean rotation as a unit quaternion with `w >= 0`, independent of the signs of the inputs.

    It is the leading eigenvector of `sum_i w_i q_i q_i^T` (F. L. Markley et al., "Averaging quaternions", J. Guidance,
    Control and Dynamics 30(4), 2007, eq. 13). It is neither unique nor differentiable if the two largest eigenvalues
    are equal, as for two rotations of equal weight that differ by pi.

    Args:
        q: (4, n): unit quaternions.
        log_weights: (n,): log weights, which need not be normalised.

    Raises:
        ValueError: If `q` is not (4, n) with the n of `log_weights`.

    Examples:
        >>> import jax, jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> angles = jnp.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])
        >>> q = jax.vmap(lie.so3_exp, out_axes=1)(angles)
        >>> round(float(lie.so3_log(lie.quaternion_mean(q, jnp.zeros(2)))[2]), 3)
        0.2
    """
    if jnp.shape(q) != (4, *jnp.shape(log_weights)):
        raise ValueError(f"q and log_weights must be (4, n) and (n,); got {jnp.shape(q)} and {jnp.shape(log_weights)}.")
    w = weights.linear(log_weights)
    moment = jnp.matmul(q * w, q.T, precision="highest")
    return _with_positive_w(quaternion_normalize(_top_eigenvector(moment)))


def _with_positive_w(q: Float[Array, "4"]) -> Float[Array, "4"]:
    return jnp.where(q[0] < 0, -q, q)


@jax.custom_jvp
def _top_eigenvector(moment: Float[Array, "4 4"]) -> Float[Array, "4"]:
    return jnp.linalg.eigh(moment)[1][:, -1]


@_top_eigenvector.defjvp
def _top_eigenvector_jvp(primals, tangents):
    # The derivative of `eigh` divides by the gaps between all eigenvalues, of which three are zero for equal rotations.
    # Only the gaps to the largest eigenvalue matter.
    (moment,), (d_moment,) = primals, tangents
    values, vectors = jnp.linalg.eigh(moment)
    top = vectors[:, -1]
    others = vectors[:, :-1]
    along = dot(others.T, dot(0.5 * (d_moment + d_moment.T), top)) / (values[-1] - values[:-1])
    return top, dot(others, along)


@pytree_dataclass
class RigidTransform:
    """A rotation followed by a translation; variables are named by their frames, `T_target_source`."""

    rotation: Float[Array, "..."]
    """(4,): unit quaternion `(w, x, y, z)`."""
    translation: Float[Array, "..."]
    """(3,): origin of the source frame in the target frame, metres."""

    @classmethod
    def identity(cls) -> "RigidTransform":
        """The identity transform, in the default float type."""
        return cls(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))

    def apply(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Points (..., 3) of the source frame in the target frame, in metres."""
        if jnp.shape(points)[-1:] != (3,):
            raise ValueError(f"points must be (..., 3); got {jnp.shape(points)}.")
        R = quaternion_to_matrix(self.rotation)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        # Not a matrix product, because accelerators round its float32 inputs to ten bits of mantissa.
        moved = [R[i, 0] * x + R[i, 1] * y + R[i, 2] * z + self.translation[i] for i in range(3)]
        return jnp.stack(moved, axis=-1)

    def inverse(self) -> "RigidTransform":
        """The inverse transform, `T_source_target` of `T_target_source`."""
        back = quaternion_conjugate(self.rotation)
        return RigidTransform(back, -RigidTransform(back, jnp.zeros_like(self.translation)).apply(self.translation))


def compose(a: RigidTransform, b: RigidTransform) -> RigidTransform:
    """The composition `T_x_z` of a = `T_x_y` and b = `T_y_z`, which applies `b` first.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.math import lie
        >>> turned = lie.RigidTransform(lie.so3_exp(jnp.array([0.0, 0.0, jnp.pi / 2])), jnp.zeros(3))
        >>> moved = lie.RigidTransform(lie.so3_exp(jnp.zeros(3)), jnp.array([1.0, 0.0, 0.0]))
        >>> print(lie.compose(turned, moved).apply(jnp.zeros(3)).round(3) + 0.0)
        [0. 1. 0.]
    """
    return RigidTransform(quaternion_multiply(a.rotation, b.rotation), a.apply(b.translation))
