"""The front door for Python: the functions that the verbs of the command call, too."""
