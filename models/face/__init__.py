"""Heads and deforming faces observed by one camera or more: geometry, templates, likelihood, recalculated landmarks."""
