"""Depth images of meshes, capsules and quadrics."""
