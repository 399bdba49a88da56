"""The output of the command `landscape`, one file per kind of result."""
