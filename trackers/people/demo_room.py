"""The synthetic default: a furnished room in which people walk past each other, from one camera or four, with truth."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxfilters._xla.compiled_quickly import compiled_fully, compiled_quickly
from jaxfilters._xla.from_host import from_host
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person.scene import patch_depth
from jaxfilters.models.synthetic.room import RoomCamera, floor_camera, looking, room_camera, room_image
from jaxfilters.models.synthetic.walkers import Routes, Walker, along_routes
from jaxfilters.typing import AnyKey

_patch_depth = compiled_quickly(patch_depth)

FLOOR_M = np.array([(-3.6, -1.2), (3.6, -1.2), (3.6, 6.0), (-3.6, 6.0)])
"""Where people walk; the doors are in the left and the right wall."""
SHAPE = (360, 480)
FOCAL_PX = 330.0
PLACES = (
    ((-0.3, -3.6, 2.9), 88.0, 22.0),
    ((5.2, 6.6, 2.8), 222.0, 23.0),
    ((-5.2, 6.6, 2.8), 318.0, 23.0),
    ((5.0, -2.8, 2.8), 140.0, 24.0),
)
"""Position in metres, heading and pitch in degrees of up to four cameras."""
BOXES = (((1.2, 0.6, 0.73), (-0.6, 2.6, 0.365)), ((0.35, 0.35, 2.2), (1.5, 3.6, 1.1)))
"""Size and centre of a desk and a pillar, metres."""
SPEEDS_M_PER_S = (1.25, 1.1, 1.35, 0.95)
STARTS_S = (0.0, 1.5, 4.0, 2.5)
SIZES_M = ((1.78, 0.46), (1.66, 0.42), (1.85, 0.48), (1.60, 0.40))
"""Heights and widths."""
CLOTHES = (
    ((60, 60, 170), (70, 50, 40)),
    ((150, 90, 50), (40, 40, 45)),
    ((70, 140, 70), (90, 110, 130)),
    ((200, 200, 205), (120, 60, 30)),
)
"""Shirts and trousers: blue, green, red."""
WAYPOINTS = (
    ((-4.5, 1.2), (1.0, 1.2), (2.8, 4.9), (-2.2, 4.6), (-2.4, 0.4), (4.5, 0.4)),
    ((4.5, 2.0), (-2.4, 1.9), (-2.4, 4.2), (2.6, 4.2), (2.4, 0.6), (-4.5, 0.6)),
    ((-4.5, 3.6), (2.6, 3.0), (2.6, 0.2), (-2.6, 0.2), (-2.6, 5.2), (4.5, 5.2)),
    ((4.5, 4.8), (0.8, 4.8), (0.8, 1.6), (-1.9, 1.7), (-1.9, 3.4), (-4.5, 3.4)),
)


@dataclass(frozen=True)
class DemoRoom:
    """A recording that is rendered frame by frame."""

    cameras: tuple[FloorCamera, ...]
    floor: np.ndarray
    """(corners, 2) metres."""
    furniture: tuple[Array, ...]
    """Depth images, one a camera."""
    routes: Routes
    fps: float
    rooms: tuple[RoomCamera, ...]
    key: AnyKey
    """Of the noise."""

    def __len__(self) -> int:
        return len(self.routes.xy)

    def image(self, camera: int, index: int) -> UInt8[np.ndarray, "rows cols 3"]:
        """Blue, green, red of a frame of a camera."""
        leaves = [leaf[index] for leaf in self.routes]
        number = index * len(PLACES) + camera
        return np.asarray(_image(self.key, number, self.rooms[camera], leaves, self.present(index)))

    def present(self, index: int) -> np.ndarray:
        """(people,) who is on the floor."""
        low, high = FLOOR_M.min(axis=0) - 0.6, FLOOR_M.max(axis=0) + 0.6
        return np.all((self.routes.xy[index] > low) & (self.routes.xy[index] < high), axis=-1)


@compiled_fully
def _image(
    key: AnyKey, number: Int[ArrayLike, ""], camera: RoomCamera, leaves: list[Array], present: Bool[Array, " people"]
) -> UInt8[Array, "rows cols 3"]:
    """The image with the `number`th noise, of people on their routes."""
    count = len(present)
    sizes = [from_host(size[:count], jnp.float32) for size in np.transpose(SIZES_M)]
    people = Walker(*(leaf.astype(jnp.float32) for leaf in leaves), *sizes)
    clothes = from_host(CLOTHES[:count], jnp.float32)
    return room_image(jax.random.fold_in(key, number), camera, people, clothes, present)[0]


def demo_room(seed: int, *, cameras: int = 1, frames: int = 240, fps: float = 10.0) -> DemoRoom:
    """Four people with their own routes and speeds; `seed` varies speeds, the pattern of the floor and the noise.

    Raises:
        ValueError: for more cameras than there are places, or none.
    """
    if not 1 <= cameras <= len(PLACES):
        raise ValueError(f"cameras must be 1 to {len(PLACES)}; got {cameras}.")
    rng = np.random.default_rng(seed)
    speeds = [speed * rng.uniform(0.92, 1.08) for speed in SPEEDS_M_PER_S]
    routes = along_routes([np.array(path) for path in WAYPOINTS], speeds, list(STARTS_S), frames, fps)
    pinhole = Pinhole.from_intrinsics(FOCAL_PX, ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2), SHAPE)
    transforms = [looking(*place) for place in PLACES[:cameras]]
    views = tuple(floor_camera(pinhole, transform) for transform in transforms)
    furniture = tuple(_patch_depth(view, _furniture()) for view in views)
    keys = jax.random.split(jax.random.key(seed), cameras)
    rooms = tuple(
        room_camera(key, pinhole, transform, depth)
        for key, transform, depth in zip(keys, transforms, furniture, strict=True)
    )
    return DemoRoom(views, FLOOR_M, furniture, routes, fps, rooms, jax.random.key(seed))


def _furniture() -> Float[np.ndarray, "faces 3 3"]:
    """The faces of all boxes as `patch_depth` takes them: a corner and two edges each, metres."""
    faces = []
    for size, middle in BOXES:
        corner, edges = np.subtract(middle, np.divide(size, 2)), np.diag(size)
        for axis in range(3):
            sides = edges[axis - 2], edges[axis - 1]
            faces += [(corner, *sides), (corner + edges[axis], *sides)]
    return np.array(faces, np.float32)
