"""Scenes with known truth and the noise of real sensors."""
