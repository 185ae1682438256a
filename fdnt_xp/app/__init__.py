"""The command line: chunks, progress, plots."""
