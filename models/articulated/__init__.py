"""A hand of links seen by one camera: state, geometry, image features, inequalities, depth ambiguities."""
