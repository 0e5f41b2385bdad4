"""Rotations and rigid motions: unit quaternions `(w, x, y, z)`, rotation vectors in radians, transforms in metres.

Every function takes one quaternion and is written as algebra on its components, so that
`vmap(in_axes=-1, out_axes=-1)` runs it as vector arithmetic over an ensemble. Values and first derivatives are
finite at the identity and at half a turn.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass

# Below this squared half-angle tangent the series' first neglected term is under float64 rounding.
_SMALL = 1e-4


def quaternion_multiply(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Hamilton product `p q`: the rotation `q` followed by the rotation `p`."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )


def quaternion_conjugate(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Inverse of a unit quaternion."""
    w, x, y, z = q
    return jnp.stack([w, -x, -y, -z])


def quaternion_normalize(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Unit quaternion along `q`. The zero quaternion has no direction and gives NaN."""
    w, x, y, z = q
    # Scaled first: in float32 the plain sum of squares underflows for norms below 1e-19.
    scale = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(abs(w), abs(x)), jnp.maximum(abs(y), abs(z))))
    w, x, y, z = w / scale, x / scale, y / scale, z / scale
    inverse_norm = jax.lax.rsqrt(w * w + x * x + y * y + z * z)
    return jnp.stack([w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm])


def quaternion_to_matrix(q: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )


def quaternion_from_matrix(R: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Unit quaternion of a rotation matrix, with `w >= 0`.

    Of the four columns `4 q_k q` that a rotation matrix yields, the longest is taken, so nothing cancels at any
    angle (S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1(3), 1978).
    """
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
    """Unit quaternion of the rotation by `|rotvec|` radians about `rotvec`."""
    x, y, z = rotvec
    angle2 = x * x + y * y + z * z
    small = angle2 < _SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, angle2))
    near_w = 1 - angle2 / 8 * (1 - angle2 / 48 * (1 - angle2 / 120))
    near_scale = 0.5 - angle2 / 48 * (1 - angle2 / 80 * (1 - angle2 / 168))
    w = jnp.where(small, near_w, jnp.cos(0.5 * angle))
    scale = jnp.where(small, near_scale, jnp.sin(0.5 * angle) / angle)
    return jnp.stack([w, scale * x, scale * y, scale * z])


def so3_log(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """Rotation vector, in radians and at most pi long, of a quaternion: inverse of `so3_exp`.

    `q` and `-q` are the same rotation and give the same vector, except at half a turn, where both signs are right.
    The length of `q` does not matter.
    """
    w, x, y, z = q
    sign = jnp.where(w < 0, -1.0, 1.0).astype(q.dtype)
    w, x, y, z = sign * w, sign * x, sign * y, sign * z
    sine2 = x * x + y * y + z * z
    small = sine2 < _SMALL * w * w
    # The half angle from both of its sides, never from one: accurate near 0 and near half a turn alike.
    sine = jnp.sqrt(jnp.where(small, 1.0, sine2))
    cosine = jnp.where(small, w, 1.0)
    tangent2 = jnp.where(small, sine2, 0.0) / (cosine * cosine)
    near = 2 / cosine * (1 - tangent2 * (1 / 3 - tangent2 * (1 / 5 - tangent2 / 7)))
    scale = jnp.where(small, near, 2 * jnp.arctan2(sine, jnp.where(small, 1.0, w)) / sine)
    return jnp.stack([scale * x, scale * y, scale * z])


def so3_retract(q: Float[Array, "4"], rotvec: Float[Array, "3"]) -> Float[Array, "4"]:
    """Rotation `q` turned by `rotvec` radians about axes that turn with it: `q exp(rotvec)`, of unit length."""
    return quaternion_normalize(quaternion_multiply(q, so3_exp(rotvec)))


def so3_local(q: Float[Array, "4"], p: Float[Array, "4"]) -> Float[Array, "3"]:
    """Rotation vector in radians that leads from `q` to `p`: `log(q^-1 p)`, what `so3_retract` takes."""
    return so3_log(quaternion_multiply(quaternion_conjugate(q), p))


def quaternion_mean(q: Float[Array, "4 n"], log_weights: Float[Array, " n"]) -> Float[Array, "4"]:
    """Weighted mean rotation as a unit quaternion with `w >= 0`; the signs of the inputs do not matter.

    The top eigenvector of `sum_i w_i q_i q_i^T` (F. L. Markley et al., "Averaging quaternions", J. Guidance, Control
    and Dynamics 30(4), 2007, eq. 13). Not determined, nor differentiable, where the two largest eigenvalues are
    equal: half of the weight on each of two rotations half a turn apart.
    """
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
    # The derivative of `eigh` divides by the gaps between all eigenvalues; like rotations leave three of them at
    # zero. Only the gaps to the top one matter.
    (moment,), (d_moment,) = primals, tangents
    values, vectors = jnp.linalg.eigh(moment)
    top = vectors[:, -1]
    others = vectors[:, :-1]
    along = others.T @ (0.5 * (d_moment + d_moment.T) @ top) / (values[-1] - values[:-1])
    return top, others @ along


@pytree_dataclass
class RigidTransform:
    """Rotation, then translation; named by its frames at call sites, `T_target_source`."""

    rotation: Float[Array, "..."]
    """(4,): unit quaternion `(w, x, y, z)`."""
    translation: Float[Array, "..."]
    """(3,): origin of the source frame in the target frame, metres."""

    @classmethod
    def identity(cls) -> "RigidTransform":
        """The transform that moves nothing, in the default float type."""
        return cls(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))

    def apply(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Points of the source frame in the target frame, metres."""
        R = quaternion_to_matrix(self.rotation)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        # Not a matrix product: accelerators would round its float32 inputs to ten bits.
        moved = [R[i, 0] * x + R[i, 1] * y + R[i, 2] * z + self.translation[i] for i in range(3)]
        return jnp.stack(moved, axis=-1)

    def inverse(self) -> "RigidTransform":
        """`T_source_target` of `T_target_source`."""
        back = quaternion_conjugate(self.rotation)
        return RigidTransform(back, -RigidTransform(back, jnp.zeros_like(self.translation)).apply(self.translation))


def compose(a: RigidTransform, b: RigidTransform) -> RigidTransform:
    """`T_x_z` of `T_x_y` and `T_y_z`: first `b`, then `a`."""
    return RigidTransform(quaternion_multiply(a.rotation, b.rotation), a.apply(b.translation))
