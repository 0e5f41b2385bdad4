"""Geometry, cameras, renderers, observation and motion models."""
