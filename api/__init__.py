"""The public functions in Python, which the verbs of the command also call."""
