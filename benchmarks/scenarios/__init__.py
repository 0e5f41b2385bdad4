"""One file per scenario; each prints a table and returns named metrics."""
