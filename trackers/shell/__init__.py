"""What stands around a tracker: the command line, files in and out, video, plots, progress."""
