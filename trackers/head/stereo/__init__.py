"""Head pose and face deformation from two calibrated cameras."""
