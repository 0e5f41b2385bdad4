"""People on a floor, seen by cameras that stand still: where everybody is, in metres."""
