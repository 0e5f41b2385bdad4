"""Head pose, expression and identity from one camera, with a multilinear face model."""
