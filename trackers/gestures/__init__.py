"""Gestures drawn as strokes: models fitted to examples, and strokes recognised."""
