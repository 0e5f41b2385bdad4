"""Hand pose from a depth camera: a Rao-Blackwellized particle filter and what its command reads and draws."""
