"""A hand of links observed by one camera: state, geometry, image features, inequalities, depth ambiguities."""
