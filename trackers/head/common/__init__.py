"""What the head trackers of one and of two cameras share."""
