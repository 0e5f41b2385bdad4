"""Head pose and face deformation: `stereo` with two cameras, `mono` with one, and `common` parts."""
