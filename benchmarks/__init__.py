"""Speed and accuracy, measured beside the libraries that people would pick instead."""
