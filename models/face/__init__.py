"""Heads and deforming faces seen by one camera or more: geometry, templates, likelihood, recalculated landmarks."""
