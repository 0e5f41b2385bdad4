"""How programs are written so that XLA compiles them well. Private: nothing here changes a result."""
