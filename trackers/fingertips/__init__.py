"""The fingertips of a hand over a desk, each followed under a name of its own, and what they do."""
