"""The verbs of the command `landscape`, one file each: their options, and what they print."""
