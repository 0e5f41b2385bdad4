"""The command line, and what runs every tracker: progress, results, checkpoints, charts and videos."""
