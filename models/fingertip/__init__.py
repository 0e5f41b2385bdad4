"""Fingertips in an image, and what their places say: which is the thumb."""
