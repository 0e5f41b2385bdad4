"""Trackers as their papers published them, kept as references for the benchmarks."""
