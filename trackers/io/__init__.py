"""Files that people hand over: one safe reader for each format."""
