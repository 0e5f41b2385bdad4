"""Symbols drawn with fingertips: codes and features of strokes, and models that tell symbols apart."""
