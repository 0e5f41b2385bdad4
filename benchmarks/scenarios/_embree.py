"""Depth by Embree, the ray tracer for processors: what the renderers are measured against."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float

from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.app.devices import available_cores


class Embree:
    """Depth images of one camera, whose rays are made once."""

    def __init__(self, camera: Pinhole) -> None:
        rays = np.asarray(camera.rays(), np.float32)
        self._shape = rays.shape[:2]
        # With z = 1 the distance that Embree reports, in units of the ray, is the depth.
        self._directions = np.ascontiguousarray(rays.reshape(-1, 3))
        self._origins = np.zeros_like(self._directions)

    def depth(self, triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "rows cols"]:
        """Metres along z, `inf` where nothing is hit, of triangles in the camera frame; builds their tree first."""
        scene = EmbreeScene()
        TriangleMesh(scene, np.ascontiguousarray(triangles, np.float32))
        distance = scene.run(self._origins, self._directions, query="DISTANCE")
        return np.where(distance < 1e30, distance, np.inf).reshape(self._shape)

    def errors(
        self,
        triangles: Float[np.ndarray, "n f 3 3"],
        observed: Float[np.ndarray, "rows cols"],
        max_error: float,
    ) -> Float[np.ndarray, " n"]:
        """Sum of min(|rendered - observed|, max_error) for n poses, on all cores."""

        def of_one(pose):
            depth = self.depth(pose)
            hit = np.isfinite(depth) & ~np.isnan(observed)
            return np.minimum(np.abs(depth[hit] - observed[hit]), max_error).sum()

        with ThreadPoolExecutor(available_cores()) as pool:
            return np.array(list(pool.map(of_one, triangles)))


def joined(meshes: list[trimesh.Trimesh]) -> Float[np.ndarray, "f 3 3"]:
    """Triangles of several meshes."""
    return np.concatenate([mesh.triangles for mesh in meshes])
