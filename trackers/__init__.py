"""Complete systems, one file or folder each; what feeds them is in `shell/`."""
