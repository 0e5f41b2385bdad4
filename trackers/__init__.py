"""Six tracking systems, a folder each; `io` reads and writes files, and `app` is the command line around them."""
