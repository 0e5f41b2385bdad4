"""Head pose and face deformation, seen by one camera or several that stand still: how the tracker starts."""
